"""Our linear model inside eos (P. Huber et al., VISAPP 2016), through its Python bindings.

eos ties a landmark to one vertex. Ours lie between vertices, and a point between vertices is linear
in them, so each of the 68 is appended as a vertex of its own that no triangle uses: both programs
then fit exactly the same points of the same model.
"""

import json
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints

RIGHT_JAW, LEFT_JAW = range(0, 8), range(9, 17)


def load_eos() -> Any:
    """The eos module.

    Raises:
        ImportError: eos-py is not installed.
    """
    try:
        import eos
    except ImportError as error:
        raise ImportError("this comparison needs eos-py: pip install 'jaxface[bench]'") from error
    return eos


def _with_points(values: np.ndarray, points: SurfacePoints) -> np.ndarray:
    """Per-vertex values (n, ...) with those of the points appended."""
    corners = values[np.asarray(points.vertices)]
    weights = np.asarray(points.weights).reshape(*points.weights.shape, *[1] * (values.ndim - 1))
    return np.concatenate([values, np.sum(weights * corners, axis=1)])


def _pca(eos: Any, mean: np.ndarray, basis: LinearBasis, model: MorphableModel) -> Any:
    # eos scales unit columns by the square root of the eigenvalues; only the product matters to it.
    modes = _with_points(np.asarray(basis.basis), model.landmarks68).reshape(mean.size, -1)
    deviation = np.linalg.norm(modes, axis=0)
    return eos.morphablemodel.PcaModel(
        mean.reshape(-1, 1).astype(np.float32),
        (modes / deviation).astype(np.float32),
        (deviation**2).reshape(-1, 1).astype(np.float32),
        np.asarray(model.faces).tolist(),
    )


def edge_topology(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each edge's two faces and two vertices, counted from 1; face 0 where the surface ends."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(faces)), 3) + 1
    unique, inverse = np.unique(edges, axis=0, return_inverse=True)
    adjacent = np.zeros((len(unique), 2), int)
    for edge, face in zip(inverse.ravel(), owner, strict=True):
        adjacent[edge, int(adjacent[edge, 1] > 0) ^ 1] = face  # slot 1 first: a border keeps 0 in 0
    return adjacent, unique + 1


@dataclass(frozen=True)
class EosProblem:
    """Everything that eos's ``fit_shape_and_pose`` takes besides the landmarks."""

    eos: Any
    model: Any
    mapper: Any
    topology: Any
    contour_landmarks: Any
    model_contour: Any

    def fit(self, landmarks: np.ndarray, width: int, height: int, **settings: Any) -> Any:
        """Shape, expression and pose from 68 landmarks (px); contours as eos handles them."""
        named = [
            self.eos.core.Landmark(str(i + 1), point.astype(np.float32))
            for i, point in enumerate(landmarks)
        ]
        return self.eos.fitting.fit_shape_and_pose(
            self.model,
            named,
            self.mapper,
            width,
            height,
            self.topology,
            self.contour_landmarks,
            self.model_contour,
            **settings,
        )


def _jaw_vertices(model: MorphableModel, jaw: range) -> list[int]:
    """Vertices along one side of the jaw: those nearest to the line through its landmarks."""
    mean = np.asarray(model.mean)
    line = np.asarray(model.landmarks68(model.mean))[list(jaw)]
    t = np.linspace(0, len(line) - 1, 60)
    dense = np.stack([np.interp(t, np.arange(len(line)), line[:, axis]) for axis in range(3)], 1)
    nearest = np.argmin(np.linalg.norm(mean[None] - dense[:, None], axis=2), axis=1)
    return sorted({int(v) for v in nearest})


def eos_problem(model: MorphableModel) -> EosProblem:
    """Our model, its landmark mapping and its contour, as eos objects."""
    eos = load_eos()
    mean = _with_points(np.asarray(model.mean), model.landmarks68)
    shape = _pca(eos, mean, model.identity, model)
    expression = _pca(eos, np.zeros_like(mean), model.expression, model)
    colour = eos.morphablemodel.PcaModel()
    inside = eos.morphablemodel.MorphableModel(shape, expression, colour)
    adjacent_faces, adjacent_vertices = edge_topology(np.asarray(model.faces))
    topology = eos.morphablemodel.EdgeTopology(adjacent_faces.tolist(), adjacent_vertices.tolist())
    count = model.vertex_count
    inner = "".join(
        f"{i + 1} = {count + i}\n" for i in range(68) if i not in (*RIGHT_JAW, *LEFT_JAW)
    )
    names = {
        side: [str(i + 1) for i in jaw] for side, jaw in (("right", RIGHT_JAW), ("left", LEFT_JAW))
    }
    contour = {
        "right_contour": _jaw_vertices(model, RIGHT_JAW),
        "left_contour": _jaw_vertices(model, LEFT_JAW),
    }
    with tempfile.TemporaryDirectory() as folder:
        mapping, outline = Path(folder, "mapping.txt"), Path(folder, "contour.json")
        mapping.write_text(
            f"[landmark_mappings]\n{inner}\n[contour_landmarks]\n"
            f"right = {json.dumps(names['right'])}\nleft = {json.dumps(names['left'])}\n"
        )
        outline.write_text(json.dumps({"model_contour": contour}))
        return EosProblem(
            eos,
            inside,
            eos.core.LandmarkMapper(str(mapping)),
            topology,
            eos.fitting.ContourLandmarks.load(str(mapping)),
            eos.fitting.ModelContour.load(str(outline)),
        )


def project(parameters: Any, points: np.ndarray, width: int, height: int) -> np.ndarray:
    """Image positions (n, 2) of points (n, 3) under eos's rendering parameters, px."""
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    clip = homogeneous @ (parameters.get_projection() @ parameters.get_modelview()).T
    device = clip[:, :2] / clip[:, 3:]
    return np.stack([(device[:, 0] + 1) / 2 * width, (1 - device[:, 1]) / 2 * height], axis=1)
