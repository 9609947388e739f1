"""Albedo statistics: area-averaged per-vertex colours of the CC0 skins, mixed into a population.

The skins are few and lie at the ends of the range of complexions, so the population is drawn as
convex mixtures of them and of their mirror images. They have neither eyes nor brows: irises are
drawn from a list of colours, and brows are painted as a soft darkening of drawn colour and density.
"""

import numpy as np
from matplotlib.path import Path
from scipy import sparse

from makehuman.source import BaseMesh
from makehuman.topology import LIMBUS_ANGLE, PUPIL_ANGLE, HeadMesh

# Two skins that paint a suit's cap over the scalp and make-up over the eyes.
SKIPPED_SKINS = ("special_suit",)
SUBSAMPLES = 5
SCLERA = np.array([0.60, 0.55, 0.50])
PUPIL = np.array([0.012, 0.011, 0.010])
LIMBUS_SHADE = 0.35
TEETH = np.array([0.52, 0.46, 0.36])
TONGUE = np.array([0.40, 0.13, 0.12])
# Iris colours (linear RGB); dark complexions take the first two only.
IRISES = np.array(
    [
        [0.050, 0.024, 0.012],
        [0.085, 0.042, 0.018],
        [0.10, 0.085, 0.035],
        [0.075, 0.115, 0.145],
        [0.13, 0.15, 0.15],
    ]
)
# Brow colours from black to grey; dark complexions take the first two only.
BROWS = np.array(
    [
        [0.012, 0.009, 0.008],
        [0.030, 0.018, 0.012],
        [0.075, 0.045, 0.025],
        [0.20, 0.13, 0.07],
        [0.28, 0.26, 0.24],
    ]
)
BROW_SHARE = (0.35, 0.3, 0.2, 0.08, 0.07)
BROW_DENSITY = (0.35, 0.95)
BROW_SOFTNESS = 1.5  # mm
BROW_INSET = 0.8  # mm
DARK_SKIN_LUMINANCE = 0.2
# No light reaches the depth of the mouth: its albedo falls to this share, MOUTH_DEPTH mm in.
MOUTH_SHADE = 0.2
MOUTH_DEPTH = 22.0
MIXED = 3  # skins in a mixture
CONCENTRATION = 0.5  # of the mixture's Dirichlet weights


def hat_samples(base: BaseMesh, quads: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sample positions in the body UV of every quad, (q, s, 2), and corner weights (s, 4)."""
    t = (np.arange(SUBSAMPLES) + 0.5) / SUBSAMPLES
    a, b = (x.ravel() for x in np.meshgrid(t, t))
    weights = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
    return np.einsum("sc,qcd->qsd", weights, base.uv[base.uv_quads[quads]]), weights


def sample_bilinear(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Texture (H, W, 3) at uv (..., 2), origin bottom-left, texel centres at +0.5."""
    height, width = texture.shape[:2]
    x = np.clip(uv[..., 0] * width - 0.5, 0, width - 1.001)
    y = np.clip((1 - uv[..., 1]) * height - 0.5, 0, height - 1.001)
    i, j = y.astype(int), x.astype(int)
    fy, fx = (y - i)[..., None], (x - j)[..., None]
    top = texture[i, j] * (1 - fx) + texture[i, j + 1] * fx
    bottom = texture[i + 1, j] * (1 - fx) + texture[i + 1, j + 1] * fx
    return top * (1 - fy) + bottom * fy


def vertex_colours(base: BaseMesh, quads: np.ndarray, texture: np.ndarray) -> np.ndarray:
    """Hat-weighted area average of the texture around each base vertex (base vertices, 3)."""
    uv, weights = hat_samples(base, quads)
    corners = base.uv[base.uv_quads[quads]]
    diagonal = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    area = 0.5 * np.abs(
        diagonal[0][:, 0] * diagonal[1][:, 1] - diagonal[0][:, 1] * diagonal[1][:, 0]
    )
    colour = sample_bilinear(texture, uv)  # (q, s, 3)
    share = np.einsum("sc,qsd,q->qcd", weights, colour, area)
    total = np.einsum("sc,q->qc", weights, area)
    count = len(base.vertices)
    index = base.quads[quads].ravel()
    gather = sparse.csr_matrix(
        (np.ones(index.size), (index, np.arange(index.size))), (count, index.size)
    )
    return (gather @ share.reshape(-1, 3)) / np.maximum(gather @ total.reshape(-1, 1), 1e-12)


def skin_colours(
    base: BaseMesh, head: HeadMesh, skins: dict[str, np.ndarray], mirror: np.ndarray
) -> np.ndarray:
    """Per-vertex linear RGB (2 * skins, n, 3) of each skin and its mirror image.

    Teeth and tongue are not in the skins and get plain colours; eyeballs are left to
    ``sample_albedos``.
    """
    textured = np.flatnonzero(
        ~np.char.startswith(base.group, "helper") & ~np.char.startswith(base.group, "joint")
    )
    depth = mouth_depth(head, base)
    inside = 1 - (1 - MOUTH_SHADE) * (depth / MOUTH_DEPTH).clip(0, 1)
    colours = []
    for texture in skins.values():
        colour = head.from_base @ vertex_colours(base, textured, texture)
        colour[np.char.find(head.part, "teeth") >= 0] = TEETH
        colour[head.part == "helper-tongue"] = TONGUE
        colour *= inside[:, None]
        colours += [colour, colour[mirror]]
    return np.stack(colours)


def mouth_depth(head: HeadMesh, base: BaseMesh) -> np.ndarray:
    """How far (mm) each vertex of the mouth's inside lies behind the lips' parting, else 0."""
    z = 100.0 * (head.from_base @ base.vertices)[:, 2]
    bag = head.part == "mouth_cavity"
    inner = bag | np.char.startswith(head.part, "helper")
    return np.where(inner, (z[bag].max() - z).clip(0), 0.0)


def brow_mask(mean: np.ndarray, loops: list[np.ndarray], front: np.ndarray) -> np.ndarray:
    """Soft mask (n,) of the brows: 1 inside the loops ((k, 3) mm, seen from the front).

    It falls to 0 over BROW_SOFTNESS outside the loop and rises to 1 over as much inside, a little
    inset. ``front`` (n,) is True on the front of the head, or brows would show on its back.
    """
    mask = np.zeros(len(mean))
    for loop in loops:
        corners = loop[:, :2]
        start, edge = corners, np.roll(corners, -1, axis=0) - corners
        offset = mean[:, None, :2] - start
        t = ((offset * edge).sum(2) / (edge * edge).sum(1)).clip(0, 1)
        distance = np.linalg.norm(offset - t[..., None] * edge, axis=2).min(1)
        inside = Path(corners).contains_points(mean[:, :2])
        signed = np.where(inside, distance, -distance)
        mask = np.maximum(mask, (0.5 + (signed - BROW_INSET) / (2 * BROW_SOFTNESS)).clip(0, 1))
    return mask * front


def sample_albedos(
    skins: np.ndarray, head: HeadMesh, brows: np.ndarray, count: int, seed: int
) -> np.ndarray:
    """Per-vertex linear RGB (count, n, 3) of a drawn population.

    Args:
        skins: from ``skin_colours``.
        head: the mesh; its ``eye_angle`` places pupil, iris and sclera.
        brows: soft mask (n,), zero for a population without brows.
        count: number of faces.
        seed: of the draw.
    """
    rng = np.random.default_rng(seed)
    angle = np.nan_to_num(head.eye_angle, nan=180.0)
    is_eye = np.isfinite(head.eye_angle)
    face = head.part == "head"
    samples = np.empty((count, *skins.shape[1:]), np.float32)
    for k in range(count):
        chosen = rng.choice(len(skins), MIXED, replace=False)
        share = rng.dirichlet([CONCENTRATION] * MIXED)
        colour = np.einsum("s,snc->nc", share, skins[chosen])
        dark = np.median(colour[face] @ [0.2126, 0.7152, 0.0722]) < DARK_SKIN_LUMINANCE
        iris = IRISES[rng.integers(2 if dark else len(IRISES))] * rng.uniform(0.7, 1.3)
        shades = np.array(BROW_SHARE[:2] if dark else BROW_SHARE)
        brow = BROWS[rng.choice(len(shades), p=shades / shades.sum())]
        density = rng.uniform(*BROW_DENSITY) * brows[:, None]
        colour = colour * (1 - density) + np.minimum(brow, colour) * density
        colour[is_eye] = SCLERA * rng.uniform(0.85, 1.1)
        colour[(angle > PUPIL_ANGLE) & (angle < LIMBUS_ANGLE)] = iris
        colour[(angle > 0.8 * LIMBUS_ANGLE) & (angle < LIMBUS_ANGLE)] = iris * (1 - LIMBUS_SHADE)
        colour[angle < PUPIL_ANGLE] = PUPIL
        samples[k] = colour
    return samples
