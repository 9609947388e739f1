"""Triangle meshes: normals, edges, adjacency, boundary.

Normals are JAX functions of the vertices. Topology (edges, neighbours, boundary) depends on
integers alone, has data-dependent sizes, and is computed once, by NumPy, outside jit.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool as NpBool
from jaxtyping import Int as NpInt

from jaxface._numerics import above_rounding, cross, safe_normalize
from jaxface._types import Array, Float, Int


def face_areas_normals(
    vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]
) -> Float[Array, "f 3"]:
    """Area-weighted normals: outward for counter-clockwise corners, as long as twice the area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return cross(b - a, c - a)


def face_normals(vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]) -> Float[Array, "f 3"]:
    """Unit normals of the triangles; zero, with a zero derivative, where the area is zero.

    An area counts as zero if it is within the rounding of the products it is made from.
    """
    weighted, size = _weighted_normals(vertices, faces)
    return safe_normalize(above_rounding(weighted, size))


def _weighted_normals(
    vertices: Float[Array, "n 3"], faces: Int[Array, "f 3"]
) -> tuple[Float[Array, "f 3"], Float[Array, "f"]]:
    """Area-weighted normals, and the size of the products that each is a difference of."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    size = jnp.max(jnp.abs(b - a), axis=-1) * jnp.max(jnp.abs(c - a), axis=-1)
    return cross(b - a, c - a), jax.lax.stop_gradient(size)


def vertex_normals(
    vertices: Float[Array, "n 3"],
    faces: Int[Array, "f 3"],
    incident: Int[Array, "n v"] | None = None,
) -> Float[Array, "n 3"]:
    """Unit normals of the vertices: the area-weighted mean of the triangles around each.

    Args:
        vertices: mm, or any unit.
        faces: triangles, counter-clockwise seen from outside.
        incident: the table of ``incident_faces``; with it the sums are gathers, which run in
            parallel, rather than a scatter.

    Returns:
        Zero, with a zero derivative, at vertices without a triangle of positive area, and where
        triangles that face opposite ways cancel to within rounding.
    """
    weighted, size = _weighted_normals(vertices, faces)

    def around(values: Array) -> Array:
        if incident is None:
            each, owner = jnp.repeat(values, 3, axis=0), jnp.reshape(faces, -1)
            return jax.ops.segment_sum(each, owner, vertices.shape[0])
        present = (incident >= 0).reshape(*incident.shape, *[1] * (values.ndim - 1))
        return jnp.sum(jnp.where(present, values[jnp.maximum(incident, 0)], 0.0), axis=1)

    return safe_normalize(above_rounding(around(weighted), around(size)))


def edges(faces: NpInt[np.ndarray, "f 3"]) -> NpInt[np.ndarray, "e 2"]:
    """Every undirected edge once, the smaller vertex index first, in lexicographic order."""
    return _edge_counts(faces)[0]


def edge_faces(faces: NpInt[np.ndarray, "f 3"]) -> NpInt[np.ndarray, "e 2"]:
    """The two triangles at each edge of ``edges``; the second is -1 on a boundary.

    Raises:
        ValueError: more than two triangles share an edge.
    """
    faces = np.asarray(faces)
    _, counts, inverse = _edge_counts(faces)
    if counts.size and counts.max() > 2:
        raise ValueError(
            f"an edge is shared by {counts.max()} triangles; a manifold mesh has at most 2"
        )
    owner = np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(inverse, kind="stable")
    starts = np.cumsum(counts) - counts
    table = np.full((len(counts), 2), -1, np.int32)
    table[:, 0] = owner[order[starts]]
    shared = counts == 2
    table[shared, 1] = owner[order[starts[shared] + 1]]
    return table


def vertex_neighbours(
    faces: NpInt[np.ndarray, "f 3"], vertex_count: int
) -> NpInt[np.ndarray, "n v"]:
    """Vertices joined to each vertex by an edge, ascending, padded with -1."""
    pairs = edges(faces)
    directed = np.concatenate([pairs, pairs[:, ::-1]])
    return _padded_table(directed[:, 0], directed[:, 1], vertex_count)


def incident_faces(faces: NpInt[np.ndarray, "f 3"], vertex_count: int) -> NpInt[np.ndarray, "n v"]:
    """Triangles around each vertex, ascending, padded with -1."""
    faces = np.asarray(faces)
    return _padded_table(faces.reshape(-1), np.repeat(np.arange(len(faces)), 3), vertex_count)


def boundary_edges(faces: NpInt[np.ndarray, "f 3"]) -> NpInt[np.ndarray, "b 2"]:
    """Edges that only one triangle has."""
    pairs, counts, _ = _edge_counts(faces)
    return pairs[counts == 1]


def boundary_vertices(
    faces: NpInt[np.ndarray, "f 3"], vertex_count: int
) -> NpBool[np.ndarray, "n"]:
    """True at the vertices of boundary edges."""
    mask = np.zeros(vertex_count, bool)
    mask[boundary_edges(faces).reshape(-1)] = True
    return mask


def _edge_counts(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Unique undirected edges, how many triangles have each, and the edge of each half-edge."""
    faces = np.asarray(faces)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise ValueError(f"faces has shape {faces.shape}; (f, 3) is needed")
    half = np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2)
    pairs, inverse, counts = np.unique(
        np.sort(half, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    return pairs.astype(np.int32), counts, inverse.reshape(-1)


def _padded_table(keys: np.ndarray, values: np.ndarray, rows: int) -> np.ndarray:
    """Values grouped by key, one row a key, ascending, padded with -1."""
    order = np.lexsort((values, keys))
    keys, values = keys[order], values[order]
    counts = np.bincount(keys, minlength=rows)
    starts = np.cumsum(counts) - counts
    table = np.full((rows, int(counts.max(initial=0))), -1, np.int32)
    table[keys, np.arange(len(keys)) - starts[keys]] = values
    return table


def smooth_over_mesh(
    values: Float[Array, "n c"], faces: Int[Array, "f 3"], rounds: int
) -> Float[Array, "n c"]:
    """Per-vertex values averaged over their triangles, again and again.

    A round replaces each value by the mean over the vertex's triangles of the triangle's mean, the
    random walk of a lazy Laplacian; its standard deviation grows with the root of the rounds, by
    about 0.7 edge lengths in the first. A vertex without triangles becomes zero.

    Args:
        values: c numbers a vertex.
        faces: triangles.
        rounds: number of averages.
    """
    degree = jnp.zeros((values.shape[0], 1), values.dtype).at[faces.reshape(-1)].add(1.0)

    def average(x: Array, _: None) -> tuple[Array, None]:
        mean = (x[faces[:, 0]] + x[faces[:, 1]] + x[faces[:, 2]]) / 3
        total = jnp.zeros_like(x)
        for corner in range(3):
            total = total.at[faces[:, corner]].add(mean)
        return total / jnp.maximum(degree, 1.0), None

    return jax.lax.scan(average, values, None, length=rounds)[0]
