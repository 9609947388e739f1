"""Albedo statistics: area-averaged per-vertex colours of the CC0 skins, mirrored, and their PCA."""

import numpy as np
from scipy import sparse

from makehuman.source import BaseMesh
from makehuman.topology import HeadMesh

# Two skins that paint a suit's cap over the scalp and make-up over the eyes.
SKIPPED_SKINS = ("special_suit",)
SUBSAMPLES = 5
SCLERA = np.array([0.60, 0.55, 0.50])
PUPIL = np.array([0.012, 0.011, 0.010])
LIMBUS_SHADE = 0.35
TEETH = np.array([0.52, 0.46, 0.36])
TONGUE = np.array([0.40, 0.13, 0.12])
# Iris colours drawn for each skin: dark skins take the first two only.
IRISES = np.array([[0.050, 0.024, 0.012], [0.085, 0.042, 0.018], [0.10, 0.085, 0.035],
                   [0.075, 0.115, 0.145], [0.13, 0.15, 0.15]])
DARK_SKIN_LUMINANCE = 0.2


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


def albedo_samples(
    base: BaseMesh, head: HeadMesh, skins: dict[str, np.ndarray], mirror: np.ndarray, seed: int
) -> np.ndarray:
    """Per-vertex linear RGB (2 * skins, n, 3): each skin and its mirror image.

    Eyeballs, teeth and tongue are not in the skins; they get plain colours by geometry, and each
    skin an iris colour drawn from a fixed list.
    """
    rng = np.random.default_rng(seed)
    skin_quads = np.flatnonzero(~np.char.startswith(base.group, "helper")
                                & ~np.char.startswith(base.group, "joint"))
    samples = []
    for texture in skins.values():
        colour = head.from_base @ vertex_colours(base, skin_quads, texture)
        face = colour[head.part == "head"]
        dark = np.median(face @ [0.2126, 0.7152, 0.0722]) < DARK_SKIN_LUMINANCE
        iris = IRISES[rng.integers(2 if dark else len(IRISES))]
        colour[np.char.find(head.part, "teeth") >= 0] = TEETH
        colour[head.part == "helper-tongue"] = TONGUE
        angle = head.eye_angle
        colour[angle >= 28] = SCLERA
        colour[(angle > 11) & (angle < 28)] = iris
        colour[(angle > 22) & (angle < 27)] = iris * (1 - LIMBUS_SHADE)
        colour[angle < 11] = PUPIL
        samples += [colour, colour[mirror]]
    return np.stack(samples)
