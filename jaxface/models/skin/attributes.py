"""What tells one procedural skin from another."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Float

ALBEDO_MODES = 8


class SkinAttributes(eqx.Module):
    """The traits of one subject. Amounts are 0 (none) to 1 (much) unless said otherwise."""

    male: Float[Array, ""]
    """0 female, 1 male"""
    age: Float[Array, ""]
    """years"""
    melanin: Float[Array, ""]
    """density over the model's mean skin: -0.5 very fair, 0 light brown, 2 very dark"""
    haemoglobin: Float[Array, ""]
    """density over the mean: -0.1 pale, 0.15 ruddy"""
    tone: Float[Array, "8"]
    """leading albedo modes of the model after the first, standard deviations"""
    mottling: Float[Array, ""]
    """contrast of blotches; 1 is typical"""
    pores: Float[Array, ""]
    """contrast and size of pores; 1 is typical"""
    furrows: Float[Array, ""]
    """contrast of the fine line network; 1 is typical"""
    wrinkles: Float[Array, ""]
    freckles: Float[Array, ""]
    moles: Float[Array, ""]
    blemishes: Float[Array, ""]
    """red spots"""
    age_spots: Float[Array, ""]
    stubble: Float[Array, ""]
    """0 shaven or none, 1 a beard of a few days"""
    flush: Float[Array, ""]
    """redness of nose, cheeks and ears; 1 is typical"""
    hair_melanin: Float[Array, ""]
    """darkness of beard and brow hair: 0 white, 1 black"""

    def summary(self) -> dict[str, float | list[float]]:
        """The traits as plain numbers, for a record."""
        return {
            name: [round(float(x), 4) for x in value] if value.ndim else round(float(value), 4)
            for name, value in vars(self).items()
        }


def random_attributes(key: Array) -> SkinAttributes:
    """A subject drawn from a broad population of adults.

    Sexes are even, ages 18 to 80, complexions from very fair to very dark; freckles go with
    fair skin, stubble with men, wrinkles and age spots with age.
    """
    keys = iter(jax.random.split(key, 20))

    def uniform(low: float = 0.0, high: float = 1.0) -> Array:
        return jax.random.uniform(next(keys), minval=low, maxval=high)

    def normal() -> Array:
        return jax.random.truncated_normal(next(keys), -2.2, 2.2)

    male = (uniform() < 0.5).astype(jnp.float32)
    age = 18.0 + 62.0 * uniform() ** 1.4
    old = (age - 18.0) / 62.0
    melanin = -0.45 + 2.2 * uniform() ** 1.8
    fair = jnp.clip(1.0 - (melanin + 0.45) / 0.7, 0.0, 1.0)
    return SkinAttributes(
        male=male,
        age=age,
        melanin=melanin,
        haemoglobin=0.02 + 0.06 * normal(),
        tone=0.6 * jax.random.truncated_normal(next(keys), -2.0, 2.0, (ALBEDO_MODES,)),
        mottling=jnp.exp(0.25 * normal()),
        pores=jnp.exp(0.22 * normal()) * (0.9 + 0.2 * male),
        furrows=jnp.exp(0.25 * normal()) * (0.8 + 0.5 * old),
        wrinkles=jnp.clip(old * 1.1 + 0.12 * normal(), 0.0, 1.0) ** 1.2,
        freckles=fair * uniform() ** 2.5,
        moles=uniform() ** 1.5,
        blemishes=uniform() ** 2 * (1.0 - 0.6 * old),
        age_spots=jnp.clip(old * 1.6 - 0.6, 0.0, 1.0) * uniform(),
        stubble=male * uniform(0.15, 1.0),
        flush=jnp.exp(0.3 * normal()),
        hair_melanin=jnp.clip(0.55 + 0.45 * melanin + 0.2 * normal() - 0.5 * old**3, 0.05, 1.0),
    )
