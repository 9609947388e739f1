"""Landmarks of a head scan, found by rendering it as a model without modes."""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Float
from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.resample import resize
from jaxface.models.linear import LinearBasis, empty_basis
from jaxface.models.morphable import MorphableModel
from jaxface.stages.scan._embed_landmarks import Detector, embed_landmarks
from jaxface.stages.scan.head_scan import HeadScan
from jaxface.stages.scan.transfer import texel_colours

_HEIGHT = 280.0
"""mm, first guess of a scan's height"""
_COLOUR_SIDE = 512
"""px, to which an albedo is reduced before it colours vertices"""


def scan_landmarks(
    scan: HeadScan, albedo: Float[np.ndarray, "h w 3"], detect: Detector
) -> Float[np.ndarray, "468 3"]:
    """The 468 points on a scan (in its units), found on renders of it.

    Args:
        scan: upright, looking along +z.
        albedo: its colour map, sRGB-encoded.
        detect: as for `embed_landmarks`.

    Raises:
        ValueError: as `embed_landmarks`.
    """
    small = resize(jnp.asarray(albedo), _COLOUR_SIDE, _COLOUR_SIDE)
    vertices = scan.vertices
    middle = 0.5 * (vertices.min(0) + vertices.max(0))
    scale = _HEIGHT / np.ptp(vertices[:, 1])
    corner = np.zeros(len(vertices), np.int64)
    corner[scan.faces.reshape(-1)] = scan.uv_faces.reshape(-1)
    colour = srgb_to_linear(texel_colours(small, jnp.asarray(scan.uv[corner], jnp.float32)))
    count = len(vertices)
    stand_in = MorphableModel(
        mean=jnp.asarray((vertices - middle) * scale, jnp.float32),
        identity=empty_basis(count),
        expression=empty_basis(count),
        albedo_mean=colour,
        albedo=LinearBasis(jnp.zeros((count, 3, 0)), jnp.zeros(0)),
        faces=jnp.asarray(scan.faces, jnp.int32),
        uv=jnp.asarray(scan.uv, jnp.float32),
        uv_faces=jnp.asarray(scan.uv_faces, jnp.int32),
        landmarks68=None,
        landmarks468=None,
        region=jnp.zeros(count, jnp.int32),
        name="scan",
        region_names=("face",),
        expression_names=(),
        licence="",
    )
    found = embed_landmarks(stand_in, detect)
    return np.asarray(found.points(stand_in.mean), np.float64) / scale + middle
