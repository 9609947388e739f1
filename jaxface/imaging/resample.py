"""Sampling images between their pixels: bilinear lookup, affine crops, antialiased resizing.

Coordinates are pixels, x right and y down, origin at the image's top-left corner, so the centre
of the first pixel is at (0.5, 0.5). Everything is differentiable in the image, and the lookups
in the coordinates too (piecewise).
"""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float


def bilinear(
    image: Float[Array, "h w c"], points: Float[Array, "*batch 2"]
) -> Float[Array, "*batch c"]:
    """Values at ``points`` (x, y), bilinear between pixel centres.

    Outside the image the border pixel goes on. The derivative with respect to a point is that of
    the cell it lies in, and zero outside the image.
    """
    height, width = image.shape[0], image.shape[1]
    x = jnp.clip(points[..., 0] - 0.5, 0, width - 1)
    y = jnp.clip(points[..., 1] - 0.5, 0, height - 1)
    # The last cell also holds the last pixel centre itself.
    left = jnp.clip(jnp.floor(x).astype(jnp.int32), 0, max(width - 2, 0))
    top = jnp.clip(jnp.floor(y).astype(jnp.int32), 0, max(height - 2, 0))
    right = jnp.minimum(left + 1, width - 1)
    bottom = jnp.minimum(top + 1, height - 1)
    a = (x - left)[..., None]
    b = (y - top)[..., None]
    upper = image[top, left] * (1 - a) + image[top, right] * a
    lower = image[bottom, left] * (1 - a) + image[bottom, right] * a
    return upper * (1 - b) + lower * b


def pixel_centres(height: int, width: int) -> Float[Array, "h w 2"]:
    """Coordinates (x, y) of every pixel's centre."""
    x, y = jnp.meshgrid(jnp.arange(width) + 0.5, jnp.arange(height) + 0.5)
    return jnp.stack([x, y], axis=-1)


def affine_crop(
    image: Float[Array, "h w c"], transform: Float[Array, "2 3"], height: int, width: int
) -> Float[Array, "height width c"]:
    """A crop of ``height`` x ``width`` px whose point p shows the image's point ``A p + b``.

    Args:
        image: the picture to look into.
        transform: ``[A | b]``, from crop coordinates to image coordinates (px).
        height: rows of the crop.
        width: columns of the crop.

    No antialiasing: shrink first (``pyramid``) where the crop is much coarser than the image.
    """
    points = pixel_centres(height, width) @ transform[:, :2].T + transform[:, 2]
    return bilinear(image, points)


def resize_weights(source: int, target: int) -> Float[Array, "target source"]:
    """One axis of a resize as a matrix: a triangle filter as wide as the larger pixel.

    Rows sum to one. Enlarging gives linear interpolation, shrinking an antialiased average.
    """
    scale = source / target
    support = max(scale, 1.0)
    centres = (jnp.arange(target) + 0.5) * scale
    offsets = (jnp.arange(source) + 0.5)[None] - jnp.clip(centres, 0.5, source - 0.5)[:, None]
    weights = jnp.maximum(1 - jnp.abs(offsets) / support, 0)
    return weights / jnp.sum(weights, axis=1, keepdims=True)


def resize(image: Float[Array, "h w c"], height: int, width: int) -> Float[Array, "height width c"]:
    """The image at another size, antialiased where it shrinks (separable triangle filter)."""
    rows = resize_weights(image.shape[0], height)
    columns = resize_weights(image.shape[1], width)
    return jnp.einsum("rh,hwc,sw->rsc", rows, image, columns, optimize="optimal")


def block_means(texture: Float[np.ndarray, "r r c"], side: int) -> Float[np.ndarray, "s s c"]:
    """Average over blocks of texels, on the host; a texture that is small enough stays as it is."""
    return means_of_blocks(texture, max(len(texture) // side, 1))


def means_of_blocks(image: Float[np.ndarray, "h w c"], factor: int) -> Float[np.ndarray, "a b c"]:
    """Average over blocks of ``factor`` pixels a side, on the host, in single precision.

    Args:
        image: height and width are multiples of the factor.
        factor: 1 leaves the image as it is.
    """
    values = np.asarray(image, np.float32)
    if factor == 1:
        return values
    height, width = values.shape[:2]
    blocks = values.reshape(height // factor, factor, width // factor, factor, -1)
    return blocks.mean(axis=(1, 3))
