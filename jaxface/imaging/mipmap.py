"""A pyramid of ever coarser copies of an image, sampled at the resolution a texture needs."""

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Float


class Mipmap(eqx.Module):
    """Levels of an image, each half the last, in one array of pixels.

    Williams, "Pyramidal parametrics", SIGGRAPH 1983. Levels are averages of 2 x 2 blocks (an odd
    last row or column is repeated), so position p of the image is ``p / 2^l`` in level l.
    """

    pixels: Float[Array, "p c"]
    shapes: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """(height, width) of each level, finest first"""

    @property
    def coarsest(self) -> int:
        """Index of the last level."""
        return len(self.shapes) - 1

    def bilinear(self, points: Float[Array, "n 2"], level: Array | int = 0) -> Float[Array, "n c"]:
        """Bilinear samples of one level at (x, y) px of the *image*, clamped to its edge.

        Args:
            points: positions in pixels of the finest level.
            level: whole number, one for all points or one each.
        """
        heights, widths = (jnp.array(side) for side in zip(*self.shapes, strict=True))
        starts = jnp.cumsum(heights * widths) - heights * widths
        if isinstance(level, int):
            height, width, start = *self.shapes[level], sum(h * w for h, w in self.shapes[:level])
            shrink = 0.5**level
        else:
            height, width, start = heights[level], widths[level], starts[level]
            shrink = jnp.exp2(-level.astype(points.dtype))
        x = jnp.clip(points[:, 0] * shrink - 0.5, 0.0, width - 1.0)
        y = jnp.clip(points[:, 1] * shrink - 0.5, 0.0, height - 1.0)
        left = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, jnp.maximum(width - 2, 0))
        top = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, jnp.maximum(height - 2, 0))
        u, v = x - left, y - top
        right, down = jnp.minimum(width - 1, 1), jnp.minimum(height - 1, 1) * width
        corner = start + top * width + left

        def channel(k: int) -> Array:
            def take(index: Array) -> Array:
                return self.pixels.at[index, k].get(mode="promise_in_bounds")

            upper = take(corner) * (1 - u) + take(corner + right) * u
            lower = take(corner + down) * (1 - u) + take(corner + down + right) * u
            return upper * (1 - v) + lower * v

        # One vector of points a channel: loops over a short last axis are slow on a CPU.
        return jnp.stack([channel(k) for k in range(self.pixels.shape[1])], axis=-1)

    def trilinear(
        self, points: Float[Array, "n 2"], level: Float[Array, "n"]
    ) -> Float[Array, "n c"]:
        """Samples at (x, y) px of the image, blended between the two levels around ``level``.

        ``level`` is the base-2 logarithm of the footprint in pixels; below 0 (a footprint smaller
        than a pixel) the finest level is used. Where no point asks for more, only that is read.
        """

        def fine() -> tuple[Array, ...]:
            return self._channels(self.bilinear(points))

        def blended() -> tuple[Array, ...]:
            clamped = jnp.clip(level, 0.0, self.coarsest)
            low = jnp.minimum(jnp.floor(clamped).astype(jnp.int32), max(self.coarsest - 1, 0))
            part = (clamped - low)[:, None]
            below, above = self.bilinear(points, low), self.bilinear(points, low + 1)
            return self._channels(below * (1 - part) + above * part)

        if self.coarsest == 0:
            return self.bilinear(points)
        return jnp.stack(jax.lax.cond(jnp.any(level > 0), blended, fine), axis=-1)

    def _channels(self, samples: Array) -> tuple[Array, ...]:
        return tuple(samples[:, k] for k in range(self.pixels.shape[1]))


def mipmap(image: Float[Array, "h w c"], levels: int = 6) -> Mipmap:
    """Mipmap of an image with at most ``levels`` levels, the coarsest at least 2 px a side.

    Raises:
        ValueError: ``levels`` is below 1.
    """
    if levels < 1:
        raise ValueError(f"levels is {levels}; it needs 1 or more")
    pyramid = [image]
    while len(pyramid) < levels and min(pyramid[-1].shape[:2]) >= 4:
        finer = pyramid[-1]
        height, width, channels = finer.shape
        even = jnp.pad(finer, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
        blocks = even.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, channels)
        pyramid.append(jnp.mean(blocks, axis=(1, 3)))
    pixels = jnp.concatenate([x.reshape(-1, image.shape[-1]) for x in pyramid])
    return Mipmap(pixels, tuple((x.shape[0], x.shape[1]) for x in pyramid))
