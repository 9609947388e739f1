"""The morphable face model (Saito 2017, section 3): mean, identity, expression, albedo."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int
from jaxface.models.linear import LinearBasis


class SurfacePoints(eqx.Module):
    """Points fixed to a mesh: a barycentric combination of three vertices each."""

    vertices: Int[Array, "l 3"]
    weights: Float[Array, "l 3"]

    def __call__(self, values: Float[Array, "n c"]) -> Float[Array, "l c"]:
        """Interpolate a per-vertex quantity at the points."""
        return jnp.einsum("li,lic->lc", self.weights, values[self.vertices])


class MorphableModel(eqx.Module):
    """``V = mean + A_id z_id + A_exp z_exp`` (mm) and ``I = albedo_mean + A_al z_al`` (linear RGB).

    The frame: right-handed, +y up, +z out of the face, millimetres. UV origin is bottom-left.
    """

    mean: Float[Array, "n 3"]
    identity: LinearBasis
    expression: LinearBasis
    albedo_mean: Float[Array, "n 3"]
    albedo: LinearBasis
    faces: Int[Array, "f 3"]
    """triangles, counter-clockwise seen from outside"""
    uv: Float[Array, "m 2"]
    uv_faces: Int[Array, "f 3"]
    """the triangles' corners in ``uv`` (seams: a vertex may own several uv corners)"""
    landmarks68: SurfacePoints | None
    """the 68 iBUG/Multi-PIE points (the subject's right jaw first)"""
    landmarks468: SurfacePoints | None
    """the 468 points of the MediaPipe face mesh"""
    region: Int[Array, "n"]
    """index into ``region_names`` of each vertex"""
    name: str = eqx.field(static=True)
    region_names: tuple[str, ...] = eqx.field(static=True)
    expression_names: tuple[str, ...] = eqx.field(static=True)
    licence: str = eqx.field(static=True)
    """one line: licence and credit of the data"""
    quads: Int[Array, "q 4"] | None = None
    """the same surface as quads (4th index -1: a triangle), where the source has them"""
    uv_quads: Int[Array, "q 4"] | None = None
    occlusion: Float[Array, "n 9"] | None = None
    """shading lost to self-occlusion (``render.occlusion``), of the mean face; None: no shadows"""
    occlusion_slope: Float[Array, "n 3 9"] | None = None
    """change of ``occlusion`` with each component of the vertex's unit normal, along the surface"""

    @property
    def vertex_count(self) -> int:
        """Number of vertices n."""
        return self.mean.shape[0]

    def shape(
        self, identity: Float[Array, "i"], expression: Float[Array, "e"]
    ) -> Float[Array, "n 3"]:
        """Vertices V (mm) for coefficients in standard deviations."""
        return self.mean + self.identity(identity) + self.expression(expression)

    def reflectance(self, albedo: Float[Array, "a"]) -> Float[Array, "n 3"]:
        """Per-vertex albedo I (linear RGB) for coefficients in standard deviations."""
        return self.albedo_mean + self.albedo(albedo)

    def occlusion_of(self, normals: Float[Array, "n 3"]) -> Float[Array, "n 9"]:
        """Shading lost to self-occlusion by vertices of given unit normals (model frame).

        To first order about the shape that ``occlusion`` and ``occlusion_slope`` are of: slopes
        lie in that one's tangent planes, so they add nothing there. Zero without ``occlusion``.
        """
        if self.occlusion is None:
            return jnp.zeros((self.vertex_count, 9), normals.dtype)
        if self.occlusion_slope is None:
            return self.occlusion
        return self.occlusion + jnp.einsum("nj,njk->nk", normals, self.occlusion_slope)

    def region_mask(self, *names: str) -> Array:
        """True at the vertices of the named regions.

        Raises:
            ValueError: a name is not one of ``region_names``.
        """
        unknown = [name for name in names if name not in self.region_names]
        if unknown:
            raise ValueError(
                f"model {self.name!r} has no region {unknown}; it has {list(self.region_names)}"
            )
        # The last entry is for vertices of no region, -1.
        wanted = np.array([*(name in names for name in self.region_names), False])
        return jnp.asarray(wanted)[self.region]
