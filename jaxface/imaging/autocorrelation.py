"""How like itself a picture is at a distance."""

import jax.numpy as jnp

from jaxface._types import Array, Float


def autocorrelation(values: Float[Array, "h w k"], reach: tuple[int, int]) -> Float[Array, "k a b"]:
    """Mean product of pixels that lie ``(dy, dx)`` apart, for all lags up to a reach.

    R(d) = mean_p x(p) x(p + d), over the pixels p for which p + d is inside; no periodicity.

    Args:
        values: around zero.
        reach: largest lags, rows and columns, each less than the picture's side.

    Returns:
        Lags ``dy`` from 0 to ``reach[0]``, then ``dx`` from ``-reach[1]`` to ``reach[1]``: half of
        the plane, for the other half is the same.
    """
    height, width = values.shape[:2]
    rows, columns = height + reach[0], width + reach[1]
    x = jnp.moveaxis(values, -1, 0)
    spectrum = jnp.fft.rfft2(x, (rows, columns))
    power = spectrum.real**2 + spectrum.imag**2
    sums = jnp.fft.irfft2(power, (rows, columns))[:, : reach[0] + 1]
    sums = jnp.concatenate([sums[..., columns - reach[1] :], sums[..., : reach[1] + 1]], axis=-1)
    dy, dx = jnp.arange(reach[0] + 1), jnp.abs(jnp.arange(-reach[1], reach[1] + 1))
    return sums / ((height - dy)[:, None] * (width - dx)[None])
