"""Lists of the pixels that show the face, for the photometric energy."""

import jax.numpy as jnp

from jaxface._numerics import running_count
from jaxface._types import Array, Bool, Float, Int
from jaxface.energies.photometric import PixelSamples


def sample_pixels(
    image: Float[Array, "h w 3"],
    mask: Float[Array, "h w"],
    triangle: Int[Array, "h w"],
    faces: Int[Array, "f 3"],
    face_mask: Bool[Array, "f"],
    principal: Float[Array, "2"],
    capacity: int,
    side: float | Float[Array, ""] | None = None,
) -> PixelSamples:
    """Gather the pixels that show an allowed triangle, at most ``capacity`` of them.

    If more are visible, an evenly spread subset (in scan order) stands for all.

    Args:
        image: square working image, linear RGB, or a larger canvas with it in its first corner.
        mask: weight of each pixel in [0, 1].
        triangle: visible triangle of each pixel, -1 for the background.
        faces: the mesh.
        face_mask: triangles that take part.
        principal: principal point of the camera, as fractions of the side.
        capacity: length of the lists.
        side: of the working image, px; the image's by default.
    """
    height, width = triangle.shape
    side = width if side is None else side
    flat = triangle.reshape(-1)
    weight = mask.reshape(-1) * ((flat >= 0) & face_mask[flat])
    y, x = jnp.divmod(jnp.arange(height * width), width)
    everywhere = PixelSamples(
        position=((jnp.stack([x, y], axis=-1) + 0.5) / side).astype(image.dtype),
        triangle=faces[jnp.maximum(flat, 0)],
        color=image.reshape(-1, 3),
        weight=weight.astype(image.dtype),
        principal=principal,
    )
    return thin_samples(everywhere, capacity)


def thin_samples(samples: PixelSamples, capacity: int) -> PixelSamples:
    """An evenly spread subset (in scan order) of the samples of positive weight.

    At most ``capacity`` of them; weights are kept, so a mean over the subset estimates the
    mean over all.
    """
    capacity = min(capacity, samples.weight.shape[0])
    valid = samples.weight > 0
    rank = running_count(valid) - 1
    count = rank[-1] + 1
    slot = jnp.where(count > capacity, (rank * (capacity / count)).astype(jnp.int32), rank)
    slot = jnp.where(valid, slot, capacity)
    index = (
        jnp.zeros(capacity, jnp.int32)
        .at[slot]
        .set(jnp.arange(len(valid), dtype=jnp.int32), mode="drop")
    )
    used = jnp.arange(capacity) < count
    return PixelSamples(
        position=samples.position[index],
        triangle=samples.triangle[index],
        color=samples.color[index],
        weight=jnp.where(used, samples.weight[index], 0.0),
        principal=samples.principal,
    )
