"""What a fit needs of a morphable model at one level of detail, prepared once."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float, Int, PyTree
from jaxface.geometry.mesh import boundary_vertices
from jaxface.geometry.normal_stencil import NormalStencil, normal_stencil
from jaxface.models.landmark_schemes import FACE_OVAL, JAW_68
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.regions import FACE_REGIONS, OUTLINE_REGIONS, in_regions


class FitModel(eqx.Module):
    """A morphable model with the tables that the fit gathers through."""

    model: MorphableModel
    stencil: NormalStencil
    points: SurfacePoints
    """landmarks in the scheme of the detection"""
    contour: Int[Array, "k"]
    """indices of the landmarks that slide along the outline"""
    outline: Int[Array, "c"]
    """vertices that may form the outline"""
    vertex_mask: Bool[Array, "n"]
    """vertices of the skin that the photo term compares"""
    face_mask: Bool[Array, "f"]
    """triangles that the photo term compares"""

    def with_occlusion(
        self, occlusion: Float[Array, "n 9"], slope: Float[Array, "n 3 9"] | None = None
    ) -> "FitModel":
        """The same with another transfer of self-occlusion, and its slope in the normals."""
        return eqx.tree_at(
            lambda m: (m.model.occlusion, m.model.occlusion_slope),
            self,
            (occlusion, slope),
            is_leaf=lambda x: x is None,
        )


def prepare(model: MorphableModel, landmark_count: int) -> FitModel:
    """Tables for fitting ``model`` to landmarks of a scheme.

    Args:
        model: the morphable model.
        landmark_count: 68 (iBUG) or 468 (MediaPipe) detected points.

    Raises:
        ValueError: the model has no correspondences for that scheme, or no vertices.
    """
    points = {68: model.landmarks68, 468: model.landmarks468}.get(landmark_count)
    if points is None:
        known = [
            n for n, p in ((68, model.landmarks68), (468, model.landmarks468)) if p is not None
        ]
        raise ValueError(
            f"model {model.name!r} has no correspondences for {landmark_count} landmarks (it has "
            f"them for {known or 'none'}); run `jaxface model embed-landmarks` to find them"
        )
    contour = JAW_68 if landmark_count == 68 else FACE_OVAL
    faces = np.asarray(model.faces)
    skin = in_regions(model, FACE_REGIONS)
    outline = in_regions(model, OUTLINE_REGIONS)
    outline = outline & ~boundary_vertices(faces, model.vertex_count)
    return FitModel(
        model=model,
        stencil=normal_stencil(faces, model.vertex_count),
        points=points,
        contour=jnp.array(contour, jnp.int32),
        outline=jnp.asarray(np.flatnonzero(outline), jnp.int32),
        vertex_mask=jnp.asarray(skin),
        face_mask=jnp.asarray(skin[faces].all(axis=1)),
    )


def in_precision_of(model: FitModel, tree: PyTree) -> PyTree:
    """The floating-point arrays of a pytree in the precision of a model.

    A fit is computed in its model's precision, whatever that of the photo: what a loop carries
    keeps its type. Numbers of Python stay as they are.
    """
    dtype = model.model.mean.dtype
    return jax.tree.map(lambda x: x.astype(dtype) if eqx.is_inexact_array(x) else x, tree)
