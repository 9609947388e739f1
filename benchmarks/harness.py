"""Timing with matched work: warm-up and compilation apart, devices waited for, provenance kept.

    from harness import Benchmark

    bench = Benchmark("rasterize", packages=("jax", "jaxlib", "numpy"))
    bench.time("106k triangles, 512 px", rasterize, vertices, faces)
    bench.finish()

Run a script as ``python benchmarks/NAME.py``; `finish` reads the command line (see
benchmarks/README.md), prints the table, compares and writes the results.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from jaxface.run.environment import environment

RESULTS = Path(__file__).parent / "results"
SCHEMA = 1


@dataclass(frozen=True)
class Measurement:
    """One line of a benchmark. Times are seconds; None where nothing was timed."""

    name: str
    best: float | None = None
    median: float | None = None
    compile: float | None = None
    """first call less a warm one: tracing, compilation and first-touch costs"""
    repeats: int = 0
    program: str = "jaxface"
    """whose code did the work"""
    values: dict[str, float] = field(default_factory=dict)
    """what else was measured, e.g. {"landmark error (px)": 1.3}"""


class Benchmark:
    """A named list of measurements made in one process, and where it was made."""

    def __init__(self, name: str, packages: Iterable[str] = ("jax", "jaxlib", "numpy")) -> None:
        self.name = name
        self.measurements: list[Measurement] = []
        self.packages = ("jaxface", *packages)
        # A persistent cache would hide the compilation that is to be measured.
        jax.config.update("jax_enable_compilation_cache", False)

    def time(
        self,
        name: str,
        function: Callable[..., Any],
        *args: Any,
        repeats: int = 20,
        seconds: float = 5.0,
        program: str = "jaxface",
        values: Mapping[str, float] | Callable[[Any], Mapping[str, float]] | None = None,
        **kwargs: Any,
    ) -> Any:
        """Call once, call once more to warm up, then time up to ``repeats`` calls.

        The timed calls stop after ``seconds`` in all, though never before three. ``values`` adds
        figures, or computes them from what the function returned.

        Returns:
            The function's last result.
        """
        first, result = timed(function, *args, **kwargs)
        warm, result = timed(function, *args, **kwargs)
        samples: list[float] = []
        while len(samples) < repeats and (len(samples) < 3 or sum(samples) < seconds):
            elapsed, result = timed(function, *args, **kwargs)
            samples.append(elapsed)
        self.record(
            Measurement(
                name,
                best=min(samples),
                median=statistics.median(samples),
                compile=max(0.0, first - warm),
                repeats=len(samples),
                program=program,
                values=dict((values(result) if callable(values) else values) or {}),
            )
        )
        return result

    def record(self, measurement: Measurement) -> None:
        """Add a measurement made elsewhere, e.g. by a peer in an environment of its own.

        Raises:
            ValueError: the same program already has a measurement of this name.
        """
        key = (measurement.name, measurement.program)
        if key in {(m.name, m.program) for m in self.measurements}:
            raise ValueError(f"{key} was measured twice; give every measurement its own name")
        self.measurements.append(measurement)
        print(f"{measurement.program}: {measurement.name}: {_time(measurement.best)}", flush=True)

    def report(self) -> dict[str, Any]:
        """All of it, ready for JSON."""
        return {
            "schema": SCHEMA,
            "benchmark": self.name,
            "provenance": provenance(self.packages),
            "measurements": [asdict(m) for m in self.measurements],
        }

    def finish(self, arguments: list[str] | None = None) -> dict[str, Any]:
        """Print the table, compare with a baseline, write JSON and Markdown.

        Exits with status 1 where ``--fail-above`` is given and a ratio exceeds it.
        """
        parser = argparse.ArgumentParser(prog=f"{self.name}.py")
        parser.add_argument("--compare", type=Path, metavar="JSON", help="an earlier result")
        parser.add_argument("--fail-above", type=float, metavar="RATIO", help="slower than this")
        parser.add_argument("--output", type=Path, default=RESULTS, metavar="DIR")
        parser.add_argument("--no-write", action="store_true", help="leave the results as they are")
        options, _ = parser.parse_known_args(arguments)

        report = self.report()
        written = options.output / f"{self.name}.json"
        baseline_path = options.compare or (written if written.is_file() else None)
        baseline = json.loads(baseline_path.read_text("utf-8")) if baseline_path else None
        print("\n" + markdown(report, baseline))
        if not options.no_write:
            options.output.mkdir(parents=True, exist_ok=True)
            written.write_text(json.dumps(report, indent=2) + "\n", "utf-8")
            written.with_suffix(".md").write_text(markdown(report), "utf-8")
        worst = max(ratios(report, baseline).values(), default=0.0) if baseline else 0.0
        if options.fail_above is not None and worst > options.fail_above:
            sys.exit(f"slower than the baseline by {worst:.2f} (at most {options.fail_above})")
        return report


def timed(function: Callable[..., Any], *args: Any, **kwargs: Any) -> tuple[float, Any]:
    """Seconds of one call, until every array that it returns is there; and what it returns."""
    start = time.perf_counter()
    result = jax.block_until_ready(function(*args, **kwargs))
    return time.perf_counter() - start, result


def provenance(packages: Iterable[str] = ()) -> dict[str, Any]:
    """Date, commit, processor, cores, devices and versions; nothing that names a machine."""
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "load": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        **environment(packages),
    }


def ratios(report: Mapping[str, Any], baseline: Mapping[str, Any]) -> dict[str, float]:
    """Best time now over best time then, by "program: name"; above one is slower."""
    then = {f"{m['program']}: {m['name']}": m["best"] for m in baseline["measurements"]}
    return {
        key: m["best"] / then[key]
        for m in report["measurements"]
        if (key := f"{m['program']}: {m['name']}") in then and m["best"] and then[key]
    }


def markdown(report: Mapping[str, Any], baseline: Mapping[str, Any] | None = None) -> str:
    """The measurements as a Markdown table, with a column of ratios to the baseline if given."""
    measured = report["measurements"]
    extras = list(dict.fromkeys(key for m in measured for key in m["values"]))
    change = ratios(report, baseline) if baseline else {}
    header = ["measurement", "program", "best", "median", "compile", *extras]
    rows = []
    for m in measured:
        row = [m["name"], m["program"], _time(m["best"]), _time(m["median"]), _time(m["compile"])]
        row += [f"{m['values'][key]:.4g}" if key in m["values"] else "" for key in extras]
        if baseline:
            ratio = change.get(f"{m['program']}: {m['name']}")
            row.append(f"{ratio:.2f}" if ratio else "new")
        rows.append(row)
    if baseline:
        header.append("now / then")
    lines = [header, ["---", "---", *["---:"] * (len(header) - 2)], *rows]
    p = report["provenance"]
    packages = ", ".join(f"{name} {number}" for name, number in p["versions"].items())
    origin = (
        f"{p['date']}, commit {p['commit']}, {p['processor']}, {p['cores']} cores, "
        f"load {p['load']}, {p['device_count']} x {p['device']}, {p['system']}, {packages}"
    )
    note = ""
    if baseline and baseline["provenance"]["processor"] != p["processor"]:
        note = f"\nThe baseline is of another machine: {baseline['provenance']['processor']}.\n"
    table = "\n".join("| " + " | ".join(line) + " |" for line in lines)
    return f"# {report['benchmark']}\n\n{table}\n{note}\n{origin}\n"


def _time(seconds: float | None) -> str:
    if seconds is None:
        return ""
    return f"{seconds:.3g} s" if seconds >= 1 else f"{seconds * 1e3:.3g} ms"


def _commit() -> str:
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
