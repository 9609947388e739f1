"""The whole fit of the demo photo, warm and with compilation apart, at two levels of detail.

Working image of 512 px, 30/10/3 Gauss-Newton steps at most (a level stops early once the energy
no longer falls; the steps used are listed). ``default`` fits the bundled model with 4.6, 18 and 18
thousand vertices on the three levels, ``fine`` with 4.6, 18 and 73 thousand. Landmarks are
detected once, outside the clock.

    python benchmarks/fit.py
"""

import statistics

import numpy as np
from harness import Benchmark, Measurement

from jaxface.io.models import load_model
from jaxface.pipeline import Clock, FittedFace, fit
from jaxface.pipeline.journeys import demo_photo
from jaxface.stages.landmarks import detect_one

DETAILS = {"default": (0, 1, 1), "fine": (0, 1, 2)}


def figures(fitted: FittedFace) -> dict[str, float]:
    """Steps used on each level, vertices, and how close the landmarks came."""
    steps = {f"steps {k}": float(s) for k, s in enumerate(fitted.stats.steps[1:])}
    return {
        **steps,
        "vertices": float(fitted.model.vertex_count),
        "landmarks (% ocular)": 100 * fitted.landmark_error(),
    }


def main() -> None:
    """Time the fit's own programs: what ``Clock`` counts as the step "fit"."""
    bench = Benchmark("fit", ("jax", "jaxlib", "optimistix", "lineax", "numpy"))
    photo = demo_photo()
    points = np.asarray(detect_one(photo.pixels, None).landmarks)
    model = load_model("makehuman")
    for name, details in DETAILS.items():
        first = Clock()
        fitted = fit(photo, model, landmarks=points, details=details, clock=first)
        samples = []
        for _ in range(4):
            clock = Clock()
            fitted = fit(photo, model, landmarks=points, details=details, clock=clock)
            samples.append(clock.seconds["fit"])
        warm = samples[1:]
        bench.record(
            Measurement(
                f"{name}: 512 px, 30/10/3 steps",
                best=min(warm),
                median=statistics.median(warm),
                compile=first.compiling["fit"],
                repeats=len(warm),
                values=figures(fitted),
            )
        )
    bench.finish()


if __name__ == "__main__":
    main()
