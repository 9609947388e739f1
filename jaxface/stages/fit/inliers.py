"""Which pixels of the face really show skin: hair, hands, glasses and microphones do not.

Saito 2017 takes a learnt segmentation. Here the current fit is the reference: a pixel counts as
far as its logarithmic colour ratio to the rendered face stays within the robust spread of all
of them. The estimate is redone before every Gauss-Newton step, as the render gets better, which
makes the fit a redescending M-estimator on top of the unsquared norm of ``E_c``.
"""

import jax.numpy as jnp

from jaxface._numerics import safe_sqrt
from jaxface._types import Array, Float
from jaxface.imaging.masks import smoothstep


def inlier_weights(
    photo: Float[Array, "p 3"],
    synth: Float[Array, "p 3"],
    weight: Float[Array, "p"],
    accept: float = 2.5,
    reject: float = 4.0,
    spread_samples: int = 4096,
) -> Float[Array, "p"]:
    """Weight in [0, 1] of each pixel: 1 up to ``accept`` robust deviations, 0 from ``reject``.

    The ratio ``log((C_input + e) / (C_synth + e))`` has ``e`` a twentieth of the photo's median;
    its centre and spread are the median and 1.4826 times the median absolute deviation over an
    evenly spread subset of the pixels with positive weight. With fewer than 30 pixels all count.

    Args:
        photo: ``C_input``, linear RGB.
        synth: ``C_synth``.
        weight: pixels without weight take no part in the statistics.
        accept: deviations up to which a pixel counts fully.
        reject: deviations from which it does not count.
        spread_samples: size of the subset.
    """
    stride = max(photo.shape[0] // spread_samples, 1)
    used = weight > 0
    middle = _median(jnp.mean(photo[::stride], axis=-1, keepdims=True), used[::stride])
    floor = jnp.maximum(0.05 * middle, 1e-4)
    ratio = jnp.log(jnp.maximum(photo, 0) + floor) - jnp.log(jnp.maximum(synth, 0) + floor)
    centre = _median(ratio[::stride], used[::stride])
    spread = 1.4826 * _median(jnp.abs(ratio[::stride] - centre), used[::stride])
    deviation = (ratio - centre) / jnp.maximum(spread, 0.05)
    distance = safe_sqrt(jnp.mean(deviation**2, axis=-1))
    return jnp.where(jnp.sum(used) > 30, 1.0 - smoothstep(distance, accept, reject), 1.0)


def _median(values: Float[Array, "p c"], used: Array) -> Float[Array, "c"]:
    """Lower median of each column over the rows that are used (0 if none is)."""
    ordered = jnp.sort(jnp.where(used[:, None], values, jnp.inf), axis=0)
    found = ordered[jnp.maximum((jnp.sum(used) - 1) // 2, 0)]
    return jnp.where(jnp.isfinite(found), found, 0.0)
