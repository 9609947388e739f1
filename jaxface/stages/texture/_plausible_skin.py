"""What of a partial albedo can be skin: gloss, hair across it and leftover shading are taken out.

An unwrapped photo holds more than albedo: highlights, folds whose shadow the fitted light does not
know, strands of hair, pixels of teeth. At the size of some millimetres to centimetres skin differs
from its surroundings by a few per cent only, so what differs by more is bounded, and what differs
by far is not trusted. Detail below that size (pores, moles, hairs) is kept, but for bright spots:
skin has dark spots and hardly any bright ones; and for long dark lines, an expression's folds.
"""

from functools import partial

import jax
import jax.numpy as jnp

from jaxface._types import Array, Float
from jaxface.imaging.low_pass import low_pass
from jaxface.imaging.masks import smoothstep

FINE, WIDE = 1 / 224, 1 / 28
"""standard deviations of the low-passes that bound the band, of the texture's side: 3 and 22 mm on
the bundled model"""

LARGEST = 512
"""texels along a side of the maps in which the band is computed"""

TONE, TINT, SPARKLE = 0.07, 0.035, 0.1
"""bounds (natural logarithm of albedo): of the band's brightness, of its colour, and of bright
detail finer than it"""

LINE, LINES = (1 / 700, 1 / 110, 1 / 100), 8
"""standard deviations across and along a fold and of what lies beside it, of the texture's side: 1,
6 and 7 mm on the bundled model; and directions in which a fold is looked for"""

FOLD = 0.03
"""bound of a fold's darkness, as of the others"""

DOUBT = (0.3, 0.7)
"""brightness taken away at which trust begins to fall, and is gone"""

RESWEEPS = 3


@partial(jax.jit, static_argnames=("block",))
def _plausible(
    albedo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    base: Float[Array, "r r 3"],
    dark: Float[Array, "r r"],
    *,
    block: int,
) -> tuple[Float[Array, "r r 3"], Float[Array, "r r"]]:
    side = albedo.shape[0]
    coarse = side // block
    ratio = jnp.log(jnp.maximum(albedo, 1e-3) / jnp.maximum(base, 1e-3))

    def pooled(x: Array) -> Array:
        return x.reshape(coarse, block, coarse, block, -1).mean(axis=(1, 3))

    def mean(x: Array, trust: Array, blur: float) -> Array:
        total = low_pass(trust, blur * coarse)
        planes = [low_pass(x[..., k] * trust, blur * coarse) for k in range(x.shape[-1])]
        return jnp.stack(planes, axis=-1) / jnp.maximum(total, 1e-4)[..., None]

    share = pooled(weight[..., None])
    small = pooled(ratio * weight[..., None]) / jnp.maximum(share, 1e-4)
    share, allowed = share[..., 0], pooled(dark[..., None])
    fine = mean(small, share, FINE)
    trust = share
    wide = mean(small, trust, WIDE)
    for _ in range(RESWEEPS):
        away = (fine - wide).mean(-1)
        # Iteratively reweighted: the surroundings are the skin's, not the hair's beside it.
        trust = share / (1 + (away / (2 * TONE)) ** 2) ** 2
        wide = mean(small, trust, WIDE)
    band = fine - wide
    tone = band.mean(-1, keepdims=True)
    free = jnp.clip(tone, -allowed, 0.0)
    bounded = free + _bound(tone - free, TONE, TONE)
    tint = _bound(band - tone, TINT, TINT)
    removed = band - bounded - tint
    line = _darkest_line((small - wide - removed).mean(-1), share)
    line = jnp.minimum(line + allowed[..., 0], 0.0)[..., None]
    line = line - _bound(line, FOLD, FOLD)
    # The surroundings stay as dark as they are: every skin has some lines.
    removed = removed + line - mean(line, share, WIDE)
    removed = jax.image.resize(removed, ratio.shape, "linear")
    detail = ratio - jax.image.resize(fine, ratio.shape, "linear")
    removed = removed + detail - _bound(detail, jnp.inf, SPARKLE)
    doubt = smoothstep(jnp.abs(tone - bounded)[..., 0], *DOUBT)
    trusted = weight * (1 - jax.image.resize(doubt, weight.shape, "linear"))
    return jnp.where(weight[..., None] > 0, jnp.exp(ratio - removed) * base, albedo), trusted


def _darkest_line(tone: Float[Array, "c c"], trust: Float[Array, "c c"]) -> Float[Array, "c c"]:
    """How much darker than what lies beside it the darkest line through each pixel is; at most 0.

    Means along a line and over the stripe around it, each weighted by trust.
    """
    across, along, beside = (deviation * len(tone) for deviation in LINE)
    y, x = jnp.fft.fftfreq(len(tone))[:, None], jnp.fft.rfftfreq(len(tone))[None]
    spectra = jnp.fft.rfft2(jnp.stack([tone * trust, trust]))

    def contrast(angle: Array) -> Array:
        c, s = jnp.cos(angle), jnp.sin(angle)

        def mean(width: float) -> Array:
            square = (along * (c * x + s * y)) ** 2 + (width * (c * y - s * x)) ** 2
            both = jnp.fft.irfft2(spectra * jnp.exp(-2 * jnp.pi**2 * square), tone.shape)
            return both[0] / jnp.maximum(both[1], 0.05)

        return mean(across) - mean(beside)

    angles = jnp.arange(LINES) * (jnp.pi / LINES)
    lowest = jax.lax.map(contrast, angles).min(axis=0)
    return jnp.minimum(lowest, 0.0).astype(tone.dtype)


def _bound(x: Array, below: Array | float, above: Array | float) -> Array:
    """Keep x up to half a bound, and hold it softly between ``-below`` and ``above`` from there."""
    inner = jnp.clip(x, -0.5 * below, 0.5 * above)
    rest = 2 * (x - inner)
    negative, positive = jnp.minimum(rest, 0.0), jnp.maximum(rest, 0.0)
    return inner + 0.5 * (negative / (1 - negative / below) + positive / (1 + positive / above))


def plausible_skin(
    albedo: Float[Array, "r r 3"],
    weight: Float[Array, "r r"],
    base: Float[Array, "r r 3"],
    dark: Float[Array, "r r"],
) -> tuple[Float[Array, "r r 3"], Float[Array, "r r"]]:
    """A partial albedo without what skin cannot be, and how far to trust it then.

    ``log(albedo / base)`` is split into surroundings, a band between `FINE` and `WIDE` and detail.
    Brightness and tint of the band are bounded (as they are up to half the bound, at most the bound
    itself), of the detail only what is brighter; where much had to be taken away the weight falls
    to 0.

    Args:
        albedo: partial, linear RGB.
        weight: how far each texel is to be trusted.
        base: the model's albedo, linear RGB: what it has (brows, lips) is no departure.
        dark: how much darker than its surroundings a texel's band may be beyond `TONE`, as a
            natural logarithm: large on brows, lids, lips and in a beard.

    Returns:
        Linear RGB, and a weight that is nowhere larger than the one given.
    """
    side = albedo.shape[0]
    block = max(side // LARGEST, 1)
    return _plausible(albedo, weight, base, dark, block=block if side % block == 0 else 1)
