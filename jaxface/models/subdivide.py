"""A finer mesh for the same morphable model: coefficients keep their meaning."""

import dataclasses

import jax.numpy as jnp
import numpy as np

from jaxface._types import Float, Int
from jaxface.geometry.subdivision import Refinement, catmull_clark, loop
from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints

# Corners of a quad in the unit square, in the order of its vertices.
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def subdivide(model: MorphableModel, levels: int = 1) -> MorphableModel:
    """Refine a model: Catmull-Clark where it has quads, Loop where it has triangles only.

    Both schemes are linear, so the same sparse matrix refines the mean and every basis column
    and a coefficient vector describes the same face on every level. UV coordinates are
    interpolated linearly (seams stay put), region labels by majority, and landmarks keep their
    parametric place on their face; smoothing moves them with the surface.

    Args:
        model: the model to refine; it is not changed.
        levels: how often (each multiplies the number of faces by four).

    Raises:
        ValueError: ``levels`` is negative, or a landmark does not lie on one face.
    """
    if levels < 0:
        raise ValueError(f"levels needs to be >= 0, got {levels}")
    for _ in range(levels):
        model = _refine_once(model)
    return model


def _refine_once(model: MorphableModel) -> MorphableModel:
    count = model.vertex_count
    if model.quads is not None and model.uv_quads is not None:
        coarse, coarse_uv = np.asarray(model.quads), np.asarray(model.uv_quads)
        refined = catmull_clark(coarse, count)
        refined_uv = catmull_clark(coarse_uv, len(model.uv))
        remap = _on_refined_quads
    else:
        coarse, coarse_uv = np.asarray(model.faces), np.asarray(model.uv_faces)
        refined, refined_uv = loop(coarse, count), loop(coarse_uv, len(model.uv))
        remap = _on_refined_triangles
    matrix = refined.matrix.astype(np.float32)
    refined_count = refined.matrix.get_shape()[0]

    def apply(values: np.ndarray) -> np.ndarray:
        flat = np.asarray(values, np.float32).reshape(count, int(np.prod(values.shape[1:])))
        return (matrix @ flat).reshape(refined_count, *values.shape[1:])

    def apply_basis(basis: LinearBasis) -> LinearBasis:
        return LinearBasis(jnp.asarray(apply(np.asarray(basis.basis))), basis.std)

    labels = np.eye(len(model.region_names), dtype=np.float32)[np.asarray(model.region)]
    triangles_only = model.quads is None
    changes = {
        "mean": jnp.asarray(apply(np.asarray(model.mean))),
        "identity": apply_basis(model.identity),
        "expression": apply_basis(model.expression),
        "albedo_mean": jnp.asarray(apply(np.asarray(model.albedo_mean))),
        "albedo": apply_basis(model.albedo),
        "faces": jnp.asarray(quads_to_triangles(refined.quads), jnp.int32),
        "uv": jnp.asarray(refined_uv.linear @ np.asarray(model.uv), jnp.float32),
        "uv_faces": jnp.asarray(quads_to_triangles(refined_uv.quads), jnp.int32),
        "region": jnp.asarray(np.argmax(refined.linear @ labels, axis=1), jnp.int32),
        "quads": None if triangles_only else jnp.asarray(refined.quads, jnp.int32),
        "uv_quads": None if triangles_only else jnp.asarray(refined_uv.quads, jnp.int32),
    }
    for name in ("occlusion", "occlusion_slope"):
        if getattr(model, name) is not None:
            changes[name] = jnp.asarray(apply(np.asarray(getattr(model, name))))
    for name in ("landmarks68", "landmarks468"):
        points = getattr(model, name)
        if points is not None:
            changes[name] = remap(points, coarse, refined)
    return dataclasses.replace(model, **changes)


def quads_to_triangles(quads: Int[np.ndarray, "q 4"]) -> Int[np.ndarray, "f 3"]:
    """Two triangles per quad, split along corners 0-2; one where the 4th index is -1."""
    both = np.stack([quads[:, :3], quads[:, [0, 2, 3]]], axis=1).reshape(-1, 3)
    return both[both[:, 2] >= 0]


def _locate(
    points: SurfacePoints, faces: Int[np.ndarray, "q c"]
) -> tuple[np.ndarray, Float[np.ndarray, "l c"]]:
    """The face (l,) each point lies on, and the point's weights on that face's corners."""
    owners: dict[int, set[int]] = {}
    for corner in range(faces.shape[1]):
        for face, vertex in enumerate(faces[:, corner].tolist()):
            owners.setdefault(vertex, set()).add(face)
    vertices, weights = np.asarray(points.vertices), np.asarray(points.weights, np.float64)
    found = np.zeros(len(vertices), int)
    on_corners = np.zeros((len(vertices), faces.shape[1]))
    for i, (members, shares) in enumerate(zip(vertices, weights, strict=True)):
        used = {int(v) for v, w in zip(members, shares, strict=True) if w != 0}
        common = set.intersection(*(owners.get(v, set()) for v in used)) if used else set()
        if not common:
            raise ValueError(f"landmark {i} with vertices {members.tolist()} lies on no one face")
        found[i] = min(common)
        for vertex, share in zip(members, shares, strict=True):
            on_corners[i, faces[found[i]] == vertex] += share
    return found, on_corners


def _on_refined_quads(
    points: SurfacePoints, quads: np.ndarray, refined: Refinement
) -> SurfacePoints:
    face, weights = _locate(points, quads)
    first_child = np.searchsorted(refined.parent, np.arange(len(quads)))
    vertices, shares = [], []
    for f, w in zip(face, weights, strict=True):
        if quads[f, 3] >= 0:
            corner, (s, t) = _quarter(w @ _SQUARE)
            first, share = (t <= s), ((1 - s, s - t, t) if t <= s else (1 - t, s, t - s))
        else:
            # A child of a triangle is (corner, edge point, centroid, edge point).
            corner = int(w[:3].argmax())
            a, b, c = np.roll(w[:3], -corner)
            first = bool(c <= b)
            share = (a - b, 2 * (b - c), 3 * c) if first else (a - c, 3 * b, 2 * (c - b))
        child = refined.quads[first_child[f] + corner]
        vertices.append(child[[0, 1, 2] if first else [0, 2, 3]])
        shares.append(share)
    return SurfacePoints(jnp.asarray(vertices, jnp.int32), jnp.asarray(shares, jnp.float32))


def _quarter(place: np.ndarray) -> tuple[int, np.ndarray]:
    """Which quarter of the unit square holds ``place``, and the place inside that quarter.

    A child quad starts at its parent's corner and runs around it in the parent's sense, so its
    own axes are turned by a quarter per corner.
    """
    corner = int(np.argmin(np.abs(_SQUARE - place).max(1)))
    along = _SQUARE[(corner + 1) % 4] - _SQUARE[corner]
    across = _SQUARE[(corner - 1) % 4] - _SQUARE[corner]
    offset = place - _SQUARE[corner]
    return corner, np.clip(2 * np.array([offset @ along, offset @ across]), 0, 1)


def _on_refined_triangles(
    points: SurfacePoints, faces: np.ndarray, refined: Refinement
) -> SurfacePoints:
    face, weights = _locate(points, faces)
    vertices, shares = [], []
    for f, w in zip(face, weights, strict=True):
        corner = int(w.argmax())
        children = refined.quads[4 * f : 4 * f + 4, :3]
        if w[corner] >= 0.5:
            # Corner children keep their parent's corner in its own slot.
            local = 2 * w
            local[corner] -= 1
            vertices.append(children[corner])
        else:
            # The middle child's corners are the midpoints of edges 0-1, 1-2, 2-0.
            local = 1 - 2 * w[[2, 0, 1]]
            vertices.append(children[3])
        shares.append(local)
    return SurfacePoints(jnp.asarray(vertices, jnp.int32), jnp.asarray(shares, jnp.float32))
