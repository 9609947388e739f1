"""Shape and pose from 68 landmarks: our landmark-only fit beside eos's, on the same model.

Both get the bundled model (base mesh, all identity and expression modes, the same points) and the
same 68 points: those the model itself projects to (exact), or those plus noise of 1% of the
distance between the outer eye corners. eos solves for an orthographic camera by alternating linear
least squares, five rounds, with its own contour search for the jaw. Ours solves for a perspective
camera by Gauss-Newton, from a field of view of 28 degrees (the scenes have 15 to 40). The shape
error is the median distance over the face region after a similarity transform.

    python benchmarks/eos_fit.py
"""

import functools
import sys
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from eos_model import EosProblem, eos_problem, project
from fit_metrics import aligned_distances, face_region
from ground_truth import Subject, place
from harness import Benchmark
from landmark_fit import LandmarkFitter

from jaxface.io.face_models import load_model

SIZE = 512
YAWS = (0.0, 15.0, 30.0)
SUBJECTS = 4
INNER = slice(17, 68)
NOISE = 0.01
EOS_WEIGHTS = (30.0, 3.0)
"""its default, and one that trusts exact landmarks more"""


def scenes(model) -> list[dict[str, np.ndarray]]:
    """Random faces in random views with their 68 points (px)."""
    found = []
    for number in range(SUBJECTS):
        subject = Subject(model, np.random.default_rng([7, number]), paint=False)
        for yaw in YAWS:
            rng = np.random.default_rng([7, number, int(yaw)])
            view = place(subject.shape, subject.landmarks[27:48].mean(axis=0), yaw, SIZE, rng)
            shape = jnp.asarray(subject.shape, jnp.float32)
            points = np.asarray(model.landmarks68(shape)) @ view["rotation"].T + view["translation"]
            screen = view["focal"] * points[:, :2] / -points[:, 2:] * [1, -1] + view["principal"]
            ocular = np.linalg.norm(screen[36] - screen[45])
            noisy = screen + rng.normal(size=screen.shape) * NOISE * ocular / np.sqrt(2)
            found.append(
                {
                    "shape": subject.shape,
                    "exact": screen,
                    "noisy": noisy,
                    "ocular": np.array(ocular),
                }
            )
    return found


def fit_eos(
    problem: EosProblem, count: int, weight: float, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and landmarks (px) of eos's fit; ``weight`` is that of both of its priors."""
    mesh, parameters, *_ = problem.fit(
        points, SIZE, SIZE, lambda_identity=weight, lambda_expressions=weight
    )
    vertices = np.stack(mesh.vertices)[:, :3]
    return vertices[:count], project(parameters, vertices[count:], SIZE, SIZE)


def main() -> None:
    bench = Benchmark("eos_fit", packages=("jax", "jaxlib", "numpy", "eos-py"))
    model = load_model("makehuman")
    region = face_region(model)
    data = scenes(model)
    ours = LandmarkFitter(model, SIZE)
    programs: dict[str, Callable] = {"jaxface": ours}
    try:
        theirs = eos_problem(model)
    except ImportError as error:
        print(error, file=sys.stderr)
    else:
        for weight in EOS_WEIGHTS:
            name = f"eos-py, weight {weight:.0f}"
            programs[name] = functools.partial(fit_eos, theirs, model.vertex_count, weight)

    for points in ("exact", "noisy"):
        for program, fit in programs.items():

            def accuracy(_, fit=fit, points=points) -> dict[str, float]:
                figures = []
                for scene in data:
                    vertices, screen = jax.tree.map(np.asarray, fit(scene[points]))
                    error = np.linalg.norm(screen - scene[points], axis=1) / scene["ocular"] * 100
                    distance = aligned_distances(vertices[region], scene["shape"][region])
                    figures.append((error[INNER].mean(), error.mean(), np.median(distance)))
                names = ("inner 51 (% ocular)", "all 68 (% ocular)", "shape, median (mm)")
                return dict(zip(names, np.mean(figures, axis=0).tolist(), strict=True))

            bench.time(
                f"68 points, {points}", fit, data[1][points], repeats=10, seconds=20.0,
                program=program, values=accuracy,
            )  # fmt: skip
    mean = np.asarray(model.mean)[region]
    flat = [np.median(aligned_distances(mean, scene["shape"][region])) for scene in data]
    print(f"mean face: {np.mean(flat):.2f} mm")
    bench.finish()


if __name__ == "__main__":
    main()
