"""Vertex normals of a linear shape model, and their derivative in every mode at once.

The area-weighted normal of vertex i is the sum of its faces' cross products,
``N_i = sum_f (v_j - v_i) x (v_k - v_i)``. Its differential gathers to one cross product for
each edge, ``dN_i = sum_j dv_j x c_ij`` with ``c_ij = v_next(j) - v_previous(j)`` around the
ring (the outer ends of the two faces at the edge) and ``c_ii = -sum_j c_ij``. That turns the
derivative for all modes of a basis into a sparse matrix product with few terms a vertex.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxface._numerics import above_rounding, cross, safe_divide, safe_norm
from jaxface._types import Array, Float, Int


class NormalStencil(eqx.Module):
    """Edges of a mesh, gathered by vertex, with the outer ends of the faces beside each.

    Rows are padded to ``d`` entries by edges whose two ends coincide (they add nothing); the
    edges of vertices with more neighbours than that continue in the ``extra`` list.
    """

    neighbor: Int[Array, "n d"]
    next: Int[Array, "n d"]
    previous: Int[Array, "n d"]
    extra: Int[Array, "x 4"]
    """(vertex, neighbor, next, previous)"""


def normal_stencil(faces: np.ndarray, vertex_count: int, width: int = 7) -> NormalStencil:
    """Build the stencil of a triangle mesh (NumPy, once a topology).

    Args:
        faces: (f, 3) counter-clockwise vertex indices. Borders and non-manifold edges are fine.
        vertex_count: number of vertices n.
        width: entries d in a row of the padded table.
    """
    faces = np.asarray(faces, np.int64)
    # In face (i, j, k) vertex j adds dv_j x (v_k - v_i) to N_i and k adds dv_k x (v_i - v_j).
    rows = np.concatenate([np.roll(faces, -s, axis=1) for s in range(3)])
    i, j, k = rows.T
    forward = np.stack([i, j, k, i], axis=1)
    backward = np.stack([i, k, i, j], axis=1)
    edges = np.concatenate([forward, backward])
    merged = _merge_pairs(edges[np.lexsort((edges[:, 1], edges[:, 0]))])
    merged = merged[np.argsort(merged[:, 0], kind="stable")]
    counts = np.bincount(merged[:, 0], minlength=vertex_count)
    start = np.concatenate([[0], np.cumsum(counts)[:-1]])
    slot = np.arange(len(merged)) - start[merged[:, 0]]
    inside = slot < width
    table = np.repeat(np.arange(vertex_count)[:, None, None], width, axis=1).repeat(3, axis=2)
    table[merged[inside, 0], slot[inside]] = merged[inside, 1:]
    neighbor, ahead, behind = (jnp.asarray(table[..., k].astype(np.int32)) for k in range(3))
    extra = jnp.asarray(merged[~inside].astype(np.int32))
    return NormalStencil(neighbor, ahead, behind, extra)


def _merge_pairs(edges: np.ndarray) -> np.ndarray:
    """Join the two halves (next - i) + (i - previous) of each manifold edge into one entry."""
    key = edges[:, 0] * (edges[:, 1].max(initial=0) + 1) + edges[:, 1]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    one, two = edges[first[count == 2]], edges[first[count == 2] + 1]
    one_is_forward, two_is_forward = one[:, 3] == one[:, 0], two[:, 3] == two[:, 0]
    manifold = one_is_forward != two_is_forward
    ahead = np.where(one_is_forward, one[:, 2], two[:, 2])
    behind = np.where(one_is_forward, two[:, 3], one[:, 3])
    joined = np.stack([one[:, 0], one[:, 1], ahead, behind], axis=1)[manifold]
    single = np.ones(len(edges), bool)
    single[first[count == 2][manifold]] = False
    single[first[count == 2][manifold] + 1] = False
    return np.concatenate([joined, edges[single]])


def normal_derivative(
    vertices: Float[Array, "n 3"], stencil: NormalStencil, basis: Float[Array, "n 3 k"]
) -> tuple[Float[Array, "n 3"], Float[Array, "n 3 k"]]:
    """Unit vertex normals and their derivative along every mode of ``basis``.

    Returns:
        The area-weighted unit normals, and ``(I - n n^T) / |N| dN`` for each mode. A vertex
        without area, or whose faces cancel to within rounding, has a zero normal and a zero
        derivative (as in ``mesh.vertex_normals``).
    """
    area_normal = jnp.zeros_like(vertices)
    size = jnp.zeros_like(vertices[:, 0])
    own = jnp.zeros_like(vertices)
    change = jnp.zeros_like(basis)

    def column(index):
        return stencil.neighbor[:, index], stencil.next[:, index], stencil.previous[:, index]

    for index in range(stencil.neighbor.shape[1]):
        neighbor, ahead, behind = column(index)
        arm = vertices[ahead] - vertices[behind]
        own = own - arm
        # Each face is met by two of the vertex's edges, and sum_j (v_j - v_i) x c_ij counts it
        # twice: it is the derivative of a quadratic form along itself.
        away = vertices[neighbor] - vertices
        area_normal = area_normal + 0.5 * cross(away, arm)
        size = size + 0.5 * _largest(away) * _largest(arm)
        change = change + _cross_modes(basis[neighbor], arm)
    if stencil.extra.shape[0]:
        vertex, neighbor, ahead, behind = stencil.extra.T
        arm = vertices[ahead] - vertices[behind]
        own = own.at[vertex].add(-arm)
        away = vertices[neighbor] - vertices[vertex]
        area_normal = area_normal.at[vertex].add(0.5 * cross(away, arm))
        size = size.at[vertex].add(0.5 * _largest(away) * _largest(arm))
        change = change.at[vertex].add(_cross_modes(basis[neighbor], arm))
    change = change + _cross_modes(basis, own)
    area_normal = above_rounding(area_normal, size)
    length = safe_norm(area_normal, keepdims=True)
    inverse = safe_divide(jnp.ones_like(length), length)
    unit = area_normal * inverse
    along = jnp.sum(unit[..., None] * change, axis=1, keepdims=True)
    return unit, (change - unit[..., None] * along) * inverse[..., None]


def _largest(vectors: Float[Array, "n 3"]) -> Float[Array, "n"]:
    return jnp.max(jnp.abs(vectors), axis=-1)


def _cross_modes(moved: Float[Array, "n 3 k"], arm: Float[Array, "n 3"]) -> Float[Array, "n 3 k"]:
    """``moved x arm`` for every mode."""
    x, y, z = moved[:, 0], moved[:, 1], moved[:, 2]
    ax, ay, az = (arm[:, axis, None] for axis in range(3))
    return jnp.stack([y * az - z * ay, z * ax - x * az, x * ay - y * ax], axis=1)
