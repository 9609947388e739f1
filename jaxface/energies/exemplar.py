r"""How far a picture is from the statistics of an exemplar, another picture of any size.

Every term is relative to the exemplar's own statistics, so that a weight means the same for every
network and every picture:

E(I) = alpha / N sum_o sum_l ||G^l(I_o) - G^l_hat_o||_F^2 / ||G^l_hat_o||_F^2
     + h / (k p) sum_c ||q_c(I) - q_c_hat||^2 / sigma_c^2

- I_o is the picture halved o times, G^l the Gramian of layer l (Gatys et al. 2015; the second sum
  of eq. 3 of Saito 2017), N the number of the pairs (o, l). Gramians of an octave see twice as far
  as those of the octave before, so that a network of few layers knows large shapes too (Snelgrove
  2017, "High-Resolution Multi-Scale Neural Texture Synthesis").
- q_c are the p quantiles (as many as pixels) along axis c of the k axes of the exemplar's
  colours, sigma_c its standard deviation
  (the histogram loss of Risser et al. 2017, "Stable and Controllable Neural Texture Synthesis and
  Style Transfer Using Histogram Losses").

A network sees one channel. A coloured picture is shown to it along each axis of the exemplar's
colours, and the Gramian is that of all their responses together, so that it also holds which
colours come with which shapes.
"""

from collections.abc import Mapping, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._numerics import safe_sqrt
from jaxface._types import Array, Float
from jaxface.energies._gram import gram
from jaxface.energies.term import Energy, Term, compose
from jaxface.imaging.colour_axes import ColourAxes, colour_axes, to_channels
from jaxface.imaging.pyramid import halve
from jaxface.networks.texture_features.network import (
    FeatureNetwork,
    blocks_up_to,
    features,
    layer_position,
)

SMALLEST_MAP = 8
"""px; side below which a layer's map has too few responses for a Gramian of an octave"""

HISTOGRAM_WEIGHT = 0.1
"""h, beside an alpha of 1"""

Grams = tuple[Mapping[str, Float[Array, "m m"]], ...]
"""by octave, finest first, then by layer"""


class ExemplarWeights(eqx.Module):
    """Weights of relative distances, each 1 for a picture of other statistics altogether."""

    alpha: float | Array = 1.0
    """of the Gramians"""
    histogram: float | Array = HISTOGRAM_WEIGHT


class ExemplarTargets(eqx.Module):
    """What a picture is to match, and what is needed to compare it: the data of the energy."""

    network: FeatureNetwork
    colours: ColourAxes
    grams: Grams
    quantiles: Float[Array, "q k"]
    """the exemplar's channels, each sorted"""
    weights: ExemplarWeights


def exemplar_targets(
    network: FeatureNetwork,
    exemplar: Float[Array, "h w c"],
    layers: Sequence[str],
    octaves: int,
    weights: ExemplarWeights,
    colours: ColourAxes | None = None,
    size: tuple[int, int] | None = None,
) -> ExemplarTargets:
    """The statistics of an exemplar.

    Args:
        network: the weights.
        exemplar: sRGB-encoded, 0 to 1, one or three channels.
        layers: names; an octave has those whose map keeps ``SMALLEST_MAP`` px.
        octaves: greatest number of octaves.
        weights: of the terms.
        colours: axes of the colours; the exemplar's own where none are given.
        size: (h, w) of the pictures that will be compared, as the exemplar's if not given; layers,
            and octaves are those that both have room for.

    Raises:
        ValueError: the network lacks a layer, or no layer fits the sizes.
    """
    blocks_up_to(network, layers)
    colours = colour_axes(exemplar) if colours is None else colours
    size = (exemplar.shape[0], exemplar.shape[1]) if size is None else size
    shorter = min(*exemplar.shape[:2], *size)
    plan = layers_by_octave((shorter, shorter), layers, octaves)
    if not plan:
        raise ValueError(
            f"exemplar has {exemplar.shape[0]}x{exemplar.shape[1]} px, the picture {size[0]}x"
            f"{size[1]}; for the layers {tuple(layers)} at least "
            f"{least_side(layers)} px are needed along each side"
        )
    grams, quantiles = _statistics(network, exemplar, colours, plan)
    return ExemplarTargets(network, colours, grams, quantiles, weights)


@partial(jax.jit, static_argnums=3)
def _statistics(
    network: FeatureNetwork,
    exemplar: Float[Array, "h w c"],
    colours: ColourAxes,
    plan: tuple[tuple[str, ...], ...],
) -> tuple[Grams, Float[Array, "q k"]]:
    channels = to_channels(exemplar, colours)
    flat = channels.reshape(-1, channels.shape[-1])
    return octave_grams(network, channels, plan), jnp.sort(flat, axis=0)


def layers_by_octave(
    shape: tuple[int, int], layers: Sequence[str], octaves: int
) -> tuple[tuple[str, ...], ...]:
    """Layers of each octave of a picture (h, w): those whose maps keep ``SMALLEST_MAP`` px."""
    plan = []
    for octave in range(octaves):
        side = min(shape) >> octave
        fit = [n for n in layers if side >> (layer_position(n)[0] - 1) >= SMALLEST_MAP]
        if fit:
            plan.append(tuple(fit))
    return tuple(plan)


def least_side(layers: Sequence[str]) -> int:
    """Shorter side (px) that a picture needs for one of the layers at least."""
    return SMALLEST_MAP << (min(layer_position(name)[0] for name in layers) - 1)


def octave_grams(
    network: FeatureNetwork,
    channels: Float[Array, "h w k"],
    plan: Sequence[Sequence[str]],
) -> Grams:
    """Joint Gramians of a picture's channels, by octave and layer.

    Args:
        network: the weights.
        channels: ``imaging.colour_axes.to_channels`` of the picture.
        plan: names of the layers of each octave, finest first.
    """
    found = []
    for octave, names in enumerate(plan):
        channels = halve(channels) if octave else channels
        each = [features(network, channels[..., c], names) for c in range(channels.shape[-1])]
        found.append(
            {name: gram(jnp.concatenate([maps[name] for maps in each], axis=-1)) for name in names}
        )
    return tuple(found)


def exemplar_gram_residual(
    image: Float[Array, "h w c"], args: ExemplarTargets
) -> tuple[dict[str, Float[Array, "m m"]], ...]:
    """``(G - G_hat) / (||G_hat||_F sqrt(N))``, by octave and layer."""
    plan = [tuple(octave) for octave in args.grams]
    found = octave_grams(args.network, to_channels(image, args.colours), plan)
    count = sum(len(octave) for octave in plan)

    def relative(value: Array, target: Array) -> Array:
        return (value - target) / _safe(safe_sqrt(count * jnp.sum(target**2)))

    return tuple(
        {name: relative(values[name], targets[name]) for name in targets}
        for values, targets in zip(found, args.grams, strict=True)
    )


def exemplar_histogram_residual(
    image: Float[Array, "h w c"], args: ExemplarTargets
) -> Float[Array, "p k"]:
    """``(q_c - q_c_hat) / (sigma_c sqrt(p k))`` at as many quantiles as the picture has pixels.

    Where pixels are equal the derivative is one of those that the order of equals allows.
    """
    channels = to_channels(image, args.colours)
    values = jnp.sort(channels.reshape(-1, channels.shape[-1]), axis=0)
    pixels, axes = values.shape
    known = len(args.quantiles)
    at = (jnp.arange(pixels) + 0.5) / pixels
    places = (jnp.arange(known) + 0.5) / known
    wanted = jax.vmap(lambda q: jnp.interp(at, places, q), 1, 1)(args.quantiles)
    spread = _safe(safe_sqrt(jnp.var(args.quantiles, axis=0)))
    return (values - wanted) / (spread * jnp.sqrt(jnp.asarray(pixels * axes, values.dtype)))


def exemplar_energy(histogram: bool = True) -> Energy:
    """The sum of the terms, of ``(image, ExemplarTargets)``; every term is a residual.

    Args:
        histogram: whether there is that term; its weight is in the targets.
    """
    terms = [Term("gram", exemplar_gram_residual, lambda args: args.weights.alpha)]
    if histogram:
        terms.append(
            Term("histogram", exemplar_histogram_residual, lambda args: args.weights.histogram)
        )
    return compose(terms)


def _safe(norm: Array) -> Array:
    return jnp.where(norm > 0, norm, 1.0)
