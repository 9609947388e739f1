"""Our Gauss-Newton beside optimistix's least-squares solvers: 68 landmarks to shape and pose.

One composed energy for all: the landmark, prior and focal terms of the fit, contours held, of a
random face of the bundled model whose points carry noise of 1 % of the eye distance. Ours forms
normal equations and factorises them; optimistix's factorise the Jacobian. All start at the
closed-form pose and stop at the same relative tolerance of the energy; optimistix's of the step
too.

    python benchmarks/gauss_newton.py
"""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from eos_fit import scenes
from harness import Benchmark

from jaxface._types import Array, Float
from jaxface.energies import Term, compose, focal_residual, landmark_residual, prior_residual
from jaxface.energies.landmark import LandmarkData
from jaxface.geometry.pose import pose_from_landmarks
from jaxface.io.face_models import load_model
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters, neutral_parameters
from jaxface.solvers import Problem, gauss_newton
from jaxface.stages.fit import FitWeights

SIZE = 512
FOCAL = 2.0
"""in sides of the photo, where all start"""
RTOL = 1e-5
STEPS = 100

ENERGY = compose(
    [
        Term("landmark", lambda y, d: landmark_residual(y, d[0]), FitWeights().landmark),
        Term("prior", lambda y, d: prior_residual(y), FitWeights().prior),
        Term("focal", lambda y, d: focal_residual(y, d[1]), FitWeights().focal),
    ]
)


def problem(
    model: MorphableModel, points: Float[np.ndarray, "68 2"]
) -> tuple[FaceParameters, tuple[LandmarkData, tuple[Array, Array]]]:
    """Start and data for points in px of the photo."""
    target = jnp.asarray(points / SIZE, jnp.float32)
    focal = jnp.log(jnp.asarray(FOCAL, jnp.float32))
    data = LandmarkData(
        model=model,
        points=model.landmarks68,
        target=target,
        weight=jnp.ones(68),
        principal=jnp.full(2, 0.5),
        unit=jnp.linalg.norm(target[36] - target[45]),
    )
    inner = jnp.ones(68).at[:17].set(0.0)
    pose = pose_from_landmarks(
        model.landmarks68(model.mean), target, inner, jnp.exp(focal), data.principal
    )
    y = eqx.tree_at(lambda p: p.log_focal, neutral_parameters(model), focal)
    y = eqx.tree_at(lambda p: (p.rotation, p.translation), y, pose)
    return y, (data, (focal, jnp.asarray(0.3)))


def ours(y: FaceParameters, data: Any) -> tuple[FaceParameters, Array]:
    """By our solver."""
    found = gauss_newton(Problem.of(ENERGY), y, data, steps=STEPS, rtol=RTOL)
    return found.value, found.stats["num_steps"]


def theirs(solver: Any) -> Callable[[FaceParameters, Any], tuple[FaceParameters, Array]]:
    """By one of optimistix's."""

    def solve(y: FaceParameters, data: Any) -> tuple[FaceParameters, Array]:
        found = optx.least_squares(ENERGY.residual, solver, y, data, max_steps=STEPS, throw=False)
        return found.value, found.stats["num_steps"]

    return solve


def main() -> None:
    """Measure, compare and write the results."""
    bench = Benchmark("gauss_newton", ("jax", "jaxlib", "optimistix", "lineax", "numpy"))
    model = load_model("makehuman")
    y, data = problem(model, scenes(model)[1]["noisy"])
    programs = {
        "jaxface": ours,
        "optimistix, LevenbergMarquardt": theirs(optx.LevenbergMarquardt(RTOL, RTOL)),
        "optimistix, Dogleg": theirs(optx.Dogleg(RTOL, RTOL)),
    }
    compiled = {name: jax.jit(program) for name, program in programs.items()}
    energies = {name: float(ENERGY.total(run(y, data)[0], data)) for name, run in compiled.items()}
    least = min(energies.values())
    for name, program in programs.items():
        bench.time(
            "68 landmarks",
            jax.jit(lambda *given, program=program: program(*given)),
            y,
            data,
            program=name,
            values=lambda found, name=name: {
                "steps": float(found[1]),
                "excess": energies[name] / least - 1,
            },
        )
    bench.finish()


if __name__ == "__main__":
    main()
