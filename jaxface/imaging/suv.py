"""The SUV colour space and the removal of specular reflection in it.

Mallick, Zickler, Kriegman and Belhumeur, "Beyond Lambert: reconstructing specular surfaces using
color", CVPR 2005. RGB is turned so that the first axis, S, lies along the colour of the light
source. By the dichromatic model (Shafer 1985) a colour is a diffuse part, of any colour, and a
specular one, of the source's: U and V see the diffuse part alone, S both.
"""

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._numerics import safe_arctan2, safe_norm, safe_normalize
from jaxface._types import Array, Float

# Rows: the grey axis, then two axes that span the plane across it.
_GREY_FRAME = np.array([[1, 1, 1], [2, -1, -1], [0, 1, -1]]) / np.sqrt([[3], [6], [2]])


def suv_rotation(source_colour: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation R with ``suv = R rgb``; its first row is the unit source colour.

    For a grey source U points to red and V from blue to green; for another the smallest rotation
    that takes grey to it is undone first, so that hues keep their meaning.
    """
    source = safe_normalize(source_colour)
    grey = jnp.asarray(_GREY_FRAME[0], source.dtype)
    axis = jnp.cross(source, grey)
    cross = jnp.array([[0, -1, 0], [0, 0, 0], [0, 0, 0]], source.dtype) * axis[2]
    cross = cross - cross.T
    cross = cross.at[0, 2].set(axis[1]).at[2, 0].set(-axis[1])
    cross = cross.at[1, 2].set(-axis[0]).at[2, 1].set(axis[0])
    # Rodrigues' formula for the turn from source to grey, with 1 - cos = sin^2 / (1 + cos).
    turn = jnp.eye(3, dtype=source.dtype) + cross + cross @ cross / (1 + source @ grey)
    return jnp.asarray(_GREY_FRAME, source.dtype) @ turn


def rgb_to_suv(
    rgb: Float[Array, "*shape 3"], source_colour: Float[Array, "3"]
) -> Float[Array, "*shape 3"]:
    """Turn linear RGB into SUV.

    Args:
        rgb: linear light.
        source_colour: of the light source, linear RGB, no channel negative, at any scale.
    """
    return rgb @ suv_rotation(source_colour).T


def suv_to_rgb(
    suv: Float[Array, "*shape 3"], source_colour: Float[Array, "3"]
) -> Float[Array, "*shape 3"]:
    """Inverse of ``rgb_to_suv``."""
    return suv @ suv_rotation(source_colour)


def remove_specular_peak(
    rgb: Float[Array, "h w 3"],
    source_colour: Float[Array, "3"],
    mask: Float[Array, "h w"] | None = None,
    *,
    cells: int = 8,
    hues: int = 8,
    tolerance: float = 0.5,
    chroma_blur: float = 1.0,
    rounds: int = 12,
) -> Float[Array, "h w 3"]:
    """The image with the peak in S cut down to what its chroma says is diffuse.

    Without specularity S is in a fixed proportion to the chroma ``|(U, V)|`` at all the places
    with one diffuse colour, however they are lit. That proportion is measured by the hue
    ``atan2(V, U)``, which neither shading nor specularity changes (Mallick 2005, section 3), and
    by the place in the image: a grid of cells, smoothed, of robust lower averages, in which what
    lies above the grid's own value counts less the farther it does. What S has beyond it, less
    ``tolerance`` times the robust spread, is taken away. U and V are kept as they are.

    A specularity of another colour than the source's, one that covers all skin of one hue alike,
    and clipped highlights, whose chroma is lost, stay in part.

    Differentiable, in forward and reverse mode, with respect to image and colour.

    Args:
        rgb: linear light.
        source_colour: of the light source, linear RGB at any scale.
        mask: pixels that show skin, 0 to 1; the others are left alone. By default all.
        cells: of the grid along the longer side of the masked area.
        hues: of the grid, over the range of hues that skin of this image has.
        tolerance: deviations above the measured proportion that stay.
        chroma_blur: deviation of a Gaussian over the chroma, px: cameras store it coarsely.
        rounds: of reweighting.

    Returns:
        Linear RGB, nowhere brighter than the input in S.

    Raises:
        ValueError: the shapes do not fit together.
    """
    if rgb.ndim != 3 or rgb.shape[2] != 3:
        raise ValueError(f"rgb has shape {rgb.shape}; it needs (h, w, 3) linear RGB")
    if mask is None:
        mask = jnp.ones(rgb.shape[:2], rgb.dtype)
    if mask.shape != rgb.shape[:2]:
        raise ValueError(f"mask has shape {mask.shape}; the image's is {rgb.shape[:2]}")
    if cells < 1 or hues < 1 or rounds < 1 or tolerance < 0 or chroma_blur < 0:
        raise ValueError(
            f"cells {cells}, hues {hues}, rounds {rounds}, tolerance {tolerance}, chroma_blur "
            f"{chroma_blur}; counts of 1 or more and limits of 0 or more are needed"
        )
    mask = jnp.asarray(mask, rgb.dtype)
    suv = rgb_to_suv(rgb, source_colour)
    s, u, v = suv[..., 0], suv[..., 1], suv[..., 2]
    if chroma_blur > 0:
        u, v = (_blur(x, mask, chroma_blur) for x in (u, v))
    chroma = safe_norm(jnp.stack([u, v], axis=-1))
    level = jnp.sum(mask * chroma) / jnp.maximum(jnp.sum(mask), 1e-6)
    sure = mask * jnp.minimum(chroma / jnp.maximum(level, 1e-9), 1.0) ** 2
    ratio = s / jnp.maximum(chroma, 0.02 * level + 1e-9)
    splat, slice_ = _grid(mask, u, v, sure, cells, hues)
    usual, spread = _lower_average(ratio, sure, splat, slice_, rounds)
    # A knee as wide as the spread: the cut sets in without an edge.
    beyond = (ratio - usual) / spread - tolerance
    knee = jnp.where(beyond > 0, beyond**2 / (1.0 + jnp.maximum(beyond, 0.0)), 0.0)
    specular = mask * jnp.minimum(knee * spread * chroma, jnp.maximum(s, 0.0))
    return rgb - specular[..., None] * safe_normalize(source_colour)


def _blur(image: Float[Array, "h w"], mask: Float[Array, "h w"], deviation: float) -> Array:
    """Normalised Gaussian blur inside the mask; the image itself where the mask is empty."""
    radius = int(np.ceil(3 * deviation))
    kernel = np.exp(-0.5 * (np.arange(-radius, radius + 1) / deviation) ** 2)
    kernel = jnp.asarray(kernel / kernel.sum(), image.dtype)

    def smooth(x: Array) -> Array:
        for axis in (0, 1):
            x = jax.vmap(lambda line: jnp.convolve(line, kernel, "same"), 1 - axis, 1 - axis)(x)
        return x

    known = smooth(mask)
    return jnp.where(known > 1e-3, smooth(image * mask) / jnp.maximum(known, 1e-3), image)


def _grid(mask: Array, u: Array, v: Array, sure: Array, cells: int, hues: int):
    """Splat to and slice from a grid of (rows, columns, hues), linear along each axis."""
    # Hues are measured from their mean direction, so that they do not wrap around.
    mean = safe_normalize(jnp.stack([jnp.sum(sure * u), jnp.sum(sure * v)]))
    along, across = u * mean[0] + v * mean[1], v * mean[0] - u * mean[1]
    hue = safe_arctan2(across, along)
    total = jnp.maximum(jnp.sum(sure), 1e-6)
    width = jnp.sqrt(jnp.sum(sure * hue**2) / total + 1e-6)
    hue = (hue / (2.5 * width) + 1) / 2
    height, length = mask.shape
    rows, columns = jnp.arange(height) + 0.5, jnp.arange(length) + 0.5
    used = mask > 0
    ends = [_extent(jnp.any(used, axis=1), rows), _extent(jnp.any(used, axis=0), columns)]
    side = jnp.maximum(jnp.maximum(ends[0][1] - ends[0][0], ends[1][1] - ends[1][0]), 1.0)
    down = _hat((rows - ends[0][0]) / side, cells).astype(mask.dtype)
    right = _hat((columns - ends[1][0]) / side, cells).astype(mask.dtype)
    depth = _hat(hue, hues)

    def splat(x: Array) -> Array:
        return jnp.einsum("yi,xj,yxk->ijk", down, right, depth * x[..., None], optimize="optimal")

    def slice_(grid: Array) -> Array:
        plane = jnp.einsum("yi,xj,ijk->yxk", down, right, grid, optimize="optimal")
        return jnp.sum(plane * depth, axis=-1)

    return splat, slice_


def _extent(used: Array, at: Array) -> tuple[Array, Array]:
    return jnp.min(jnp.where(used, at, jnp.inf)), jnp.max(jnp.where(used, at, -jnp.inf))


def _hat(x: Array, count: int) -> Array:
    """(..., count) weights of linear interpolation between ``count`` nodes over [0, 1]."""
    place = jnp.clip(x, 0.0, 1.0) * (count - 1)
    return jnp.maximum(1.0 - jnp.abs(place[..., None] - jnp.arange(count, dtype=x.dtype)), 0.0)


def _lower_average(ratio: Array, sure: Array, splat, slice_, rounds: int) -> tuple[Array, Array]:
    """Per-pixel robust average of the ratio that high outliers do not lift, and its spread."""
    usable = jnp.where(sure > 0.05, ratio, jnp.nan)
    low, middle = (jnp.nan_to_num(jnp.nanquantile(usable, q)) for q in (0.2, 0.5))
    spread = jnp.maximum(middle - low, 0.02 * jnp.abs(middle) + 1e-6)
    usual = jnp.full_like(ratio, middle)

    def step(carry: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        usual, spread = carry
        off = (ratio - usual) / spread
        weight = sure / (1.0 + jnp.maximum(off, 0.0) ** 2) ** 2
        known, total = splat(weight), splat(weight * ratio)
        hue_known, hue_total = jnp.sum(known, (0, 1)), jnp.sum(total, (0, 1))
        whole = jnp.sum(hue_total) / jnp.maximum(jnp.sum(hue_known), 1e-9)
        # Scarce hues lean on all of them, scarce cells on all of their hue.
        share = jnp.sum(hue_known) * 0.01
        by_hue = (hue_total + share * whole) / jnp.maximum(hue_known + share, 1e-9)
        known, total = _smoothed(known), _smoothed(total)
        share = jnp.sum(known) / known[..., 0].size * 0.3
        share = share * (hue_known / jnp.maximum(jnp.sum(hue_known), 1e-9) + 0.02)
        grid = (total + share * by_hue) / jnp.maximum(known + share, 1e-9)
        usual = slice_(grid)
        below = jnp.where(ratio < usual, sure, 0.0)
        variance = jnp.sum(below * (ratio - usual) ** 2) / jnp.maximum(jnp.sum(below), 1e-6)
        return (usual, jnp.sqrt(variance + (0.005 * jnp.abs(middle) + 1e-6) ** 2)), None

    (usual, spread), _ = jax.lax.scan(step, (usual, spread), None, length=rounds)
    return usual, spread


def _smoothed(grid: Float[Array, "i j k"]) -> Array:
    """Binomial blur along every axis."""
    for axis in range(3):
        size = grid.shape[axis]
        padded = jnp.pad(grid, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        parts = [jax.lax.slice_in_dim(padded, i, i + size, axis=axis) for i in range(3)]
        grid = 0.25 * parts[0] + 0.5 * parts[1] + 0.25 * parts[2]
    return grid
