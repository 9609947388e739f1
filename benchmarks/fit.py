"""The whole fit of the demo photo, warm and with compilation apart, at two levels of detail.

Working image of 512 px, 30/10/3 Gauss-Newton steps at most (a level stops early once the energy
no longer falls; the steps used are listed). ``default`` fits the bundled model with 4.6, 18 and 18
thousand vertices on the three levels, ``fine`` with 4.6, 18 and 73 thousand. Times are of whole
calls, from pixels to posterior, landmarks detected anew in each; *stages* is what the fit's own
programs take of it, and *compile* what a first call in this process takes longer.

``first call`` is that of a process that has compiled nothing and keeps nothing, ``first call,
kept`` of one that also writes what it compiles to an empty cache, and ``second process`` finds it
there; all three without the import of the package.

    python benchmarks/fit.py
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time

from harness import Benchmark, Measurement

from jaxface.io.face_models import load_model
from jaxface.pipeline import Clock, FittedFace, fit
from jaxface.pipeline.photo import demo_photo
from jaxface.run.compile_cache import ENVIRONMENT, enable_compilation_cache

DETAILS = {"default": (0, 1, 1), "fine": (0, 1, 2)}


def figures(fitted: FittedFace) -> dict[str, float]:
    """Steps used on each level, vertices, and how close the landmarks came."""
    steps = {f"steps {k}": float(s) for k, s in enumerate(fitted.stats.steps[1:])}
    return {
        **steps,
        "vertices": float(fitted.model.vertex_count),
        "landmarks (% ocular)": 100 * fitted.landmark_error(),
    }


def seconds_of_a_process(cache: str) -> float:
    """How long the first call takes in a process of its own, with a cache folder ("" for none)."""
    done = subprocess.run(
        [sys.executable, __file__, "--once"],
        env={**os.environ, ENVIRONMENT: cache},
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stdout.strip().splitlines()[-1])


def once() -> None:
    """One call in this process, with the cache that the environment names."""
    enable_compilation_cache()
    photo = demo_photo()
    start = time.perf_counter()
    fit(photo)
    print(json.dumps(time.perf_counter() - start))


def main() -> None:
    """Measure, compare and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--once", action="store_true", help=argparse.SUPPRESS)
    options, remaining = parser.parse_known_args()
    if options.once:
        once()
        return
    bench = Benchmark("fit", ("jax", "jaxlib", "optimistix", "lineax", "numpy"))
    with tempfile.TemporaryDirectory() as cache:
        for name, folder, repeats in (
            ("first call", "", 2),
            ("first call, kept", cache, 1),
            ("second process", cache, 2),
        ):
            times = [seconds_of_a_process(folder) for _ in range(repeats)]
            bench.record(Measurement(name, min(times), statistics.median(times), repeats=repeats))
    photo = demo_photo()
    model = load_model("makehuman")
    for name, details in DETAILS.items():
        start = time.perf_counter()
        fitted = fit(photo, model, details=details)
        first = time.perf_counter() - start
        whole, stages = [], []
        for _ in range(5):
            clock = Clock()
            start = time.perf_counter()
            fitted = fit(photo, model, details=details, clock=clock)
            whole.append(time.perf_counter() - start)
            stages.append(clock.seconds["fit"])
        bench.record(
            Measurement(
                f"{name}: 512 px, 30/10/3 steps",
                best=min(whole),
                median=statistics.median(whole),
                compile=first - min(whole),
                repeats=len(whole),
                values={"stages (s)": min(stages), **figures(fitted)},
            )
        )
    bench.finish(remaining)


if __name__ == "__main__":
    main()
