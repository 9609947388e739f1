"""Image pyramids: the same picture at half, a quarter, ... of its size."""

import jax.numpy as jnp

from jaxface._types import Array, Float


def halve(image: Float[Array, "h w c"]) -> Float[Array, "h2 w2 c"]:
    """Half the size by averaging 2x2 blocks; the last row or column of an odd size is repeated.

    A point (x, y) px of the image is at (x / 2, y / 2) px of the result.
    """
    height, width = image.shape[0], image.shape[1]
    image = jnp.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    blocks = image.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, image.shape[2])
    return jnp.mean(blocks, axis=(1, 3))


def pyramid(image: Float[Array, "h w c"], levels: int) -> tuple[Float[Array, "_ _ c"], ...]:
    """The image and its successive halves, finest first.

    Raises:
        ValueError: ``levels`` is less than 1, or the image is too small for it.
    """
    smallest = min(image.shape[:2])
    if levels < 1 or smallest < 2 ** (levels - 1):
        raise ValueError(
            f"levels is {levels}; an image of {image.shape[1]}x{image.shape[0]} px has between 1 "
            f"and {smallest.bit_length()} levels"
        )
    result = [image]
    for _ in range(levels - 1):
        result.append(halve(result[-1]))
    return tuple(result)
