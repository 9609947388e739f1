"""Completion of held-out real skin: a part of a head scan's albedo, from the rest and a database.

Each variant is one completion, measured where nothing was seen (see texture_metrics.py). Rows are
merged by name into results/texture_quality.json, so that a part can be measured again:

    python benchmarks/texture_quality.py --only core --real DIR --database DIR --sheets DIR
"""

import argparse
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from harness import RESULTS, provenance
from held_out_skin import SCAN, Case, Skins, degraded, make_case, read_skins, read_truth
from PIL import Image
from texture_metrics import distances, inner_grams, measuring_networks
from texture_quality_table import write_results

from jaxface.imaging.colour import rgb_to_yiq
from jaxface.io.feature_weights import load_network
from jaxface.networks.texture_features.network import STYLE_LAYERS
from jaxface.pipeline.databases.painted import synth_database
from jaxface.pipeline.texture._complete import complete
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.pipeline.texture.records import Completed
from jaxface.stages.blending import blend, nearest_subject, unconstrained
from jaxface.stages.texture.detail import COMPLEXION, with_complexion

SIDE, ITERATIONS = 512, 60
"""of the rows in results/texture_quality.json"""


@dataclass(frozen=True)
class Variant:
    """One completion: what differs from the defaults."""

    group: str
    name: str
    settings: dict[str, Any] = field(default_factory=dict)
    features: str = "random"
    case: str = "left"
    subjects: int | None = None
    painted: bool = True
    """the procedural database"""
    imported: bool = False
    """the MakeHuman skins"""
    blending: Callable[..., Any] = blend
    poor: bool = False
    """what is seen is blurred and noisy"""


def variants(vgg: Path | None) -> Iterator[Variant]:
    """What is compared, in order of value."""
    for case in ("left", "oval"):
        yield Variant("core", f"completed, {case}", case=case)
    for name, carry in (("None (the paper's)", None), ("0", 0.0), ("0.5", 0.5)):
        yield Variant("carry", name, {"carry": carry})
    for case in ("left", "oval"):
        yield Variant("octaves", f"as they are, {case}", {"match_octaves": False}, case=case)
    networks = {"random-vgg19": "random-vgg19", "trained": "trained"}
    if vgg is not None:
        networks["VGG-19"] = str(vgg)
    for case in ("left", "oval"):
        for label, source in networks.items():
            layers = STYLE_LAYERS[: 3 if label == "VGG-19" else 5]
            yield Variant("features", f"{label}, {len(layers)} layers, {case}",
                          {"layers": layers}, features=source, case=case)  # fmt: skip
        yield Variant("features", f"random, 3 layers, {case}", {"layers": STYLE_LAYERS[:3]},
                      case=case)  # fmt: skip
    for photo in (0.0, 300.0):
        yield Variant("kept photo", f"{photo:g}", {"keep_photo": photo})
    yield Variant("start", "low_frequency", {"start": "low_frequency"})
    yield Variant("complexion", "as they are", {"match_complexion": False})
    yield Variant("paper", "all of the paper's", {
        "match_complexion": False, "start": "low_frequency", "carry": None,
        "keep_photo": 0.0,
    })  # fmt: skip
    yield Variant("database", "imported", painted=False, imported=True)
    yield Variant("database", "both", imported=True)
    for alpha in (20.0, 200.0, 20000.0):
        yield Variant("alpha", f"{alpha:g}", {"alpha": alpha})
    for count in (1, 2, 3, 4):
        yield Variant("layers", f"{count}", {"layers": STYLE_LAYERS[:count]})
    for count in (4, 8, 16):
        yield Variant("subjects", f"{count}", subjects=count)
    for name, how in (("convex", blend), ("free", unconstrained), ("nearest", nearest_subject)):
        yield Variant("poor photo", name, blending=how, poor=True)
    yield Variant("blending", "nearest", blending=nearest_subject)
    yield Variant("blending", "free", blending=unconstrained)
    yield Variant("views", "completed, right", case="right")


class Bench:
    """Truth, databases and what was completed."""

    def __init__(self, options: argparse.Namespace) -> None:
        self.options, self.side = options, options.side
        self.truth = read_truth(options.real, self.side)
        self.cases: dict[str, Case] = {}
        self.columns: dict[str, tuple[Any, Any]] = {}

    @cached_property
    def painted(self) -> Skins:
        """The procedural skins."""
        folder = self.options.database
        if folder is None:
            folder = self.options.cache
            synth_database(folder, 32, 2 * self.side)
        return read_skins(folder, self.side)

    @cached_property
    def imported(self) -> Skins:
        """The other skins of the real database; never the truth itself."""
        return read_skins(self.options.real, self.side, without=(SCAN,))

    def case(self, name: str) -> Case:
        """A case, made once."""
        if name not in self.cases:
            self.cases[name] = make_case(self.truth, name)
        return self.cases[name]

    def measured(self, texture: np.ndarray, case: Case) -> dict[str, float]:
        """Distances from the truth in the hidden part."""
        return distances(texture, case.truth, case.hidden, self.options.vgg)

    def database(self, variant: Variant) -> Skins:
        """The subjects of a variant."""
        parts = [self.painted] if variant.painted else []
        if variant.imported:
            parts.append(self.imported)
        whole = parts[0] if len(parts) == 1 else parts[0].joined(parts[1])
        return whole if variant.subjects is None else whole.first(variant.subjects)

    def complete(self, variant: Variant) -> tuple[dict[str, float], Completed, Case]:
        """One completion, measured."""
        case = self.case(variant.case)
        case = degraded(case) if variant.poor else case
        settings = replace(
            CompletionOptions(), iterations=self.options.iterations, **variant.settings
        )
        started = time.perf_counter()
        done = complete(
            case.seen,
            self.database(variant),
            load_network(variant.features),
            settings,
            blending=self.blending(variant, settings, variant.blending),
        )
        seconds = time.perf_counter() - started
        values = self.measured(done.albedo, case)
        values["seconds"] = seconds
        values["subjects used"] = float(np.sum(np.abs(done.blended.weights) > 1e-3))
        return values, done, case

    def blending(
        self, variant: Variant, settings: CompletionOptions, how: Callable[..., Any]
    ) -> Any:
        """A blend from an analysis that was made before, or the function to make it with."""
        same = (
            variant.case, variant.features, variant.subjects, variant.painted, variant.imported,
            variant.poor, settings.layers, settings.match_complexion,
        )  # fmt: skip
        key = repr(same)
        if key in self.columns:
            return how(*self.columns[key], norm=settings.norm)

        def remembered(columns: Any, goal: Any, norm: Any) -> Any:
            self.columns[key] = columns, goal
            return how(columns, goal, norm=norm)

        return remembered

    def baselines(self, variant: Variant, done: Completed, case: Case) -> dict[str, Any]:
        """What a completion must beat, and what no completion knows."""
        skins, rows = self.database(variant), {}
        rows["low frequencies"] = case.seen["low_frequency"]
        plain, own = {}, {}
        network = load_network(variant.features)
        for settings, found in (({"match_complexion": False}, plain), ({}, own)):
            given = replace(CompletionOptions(), iterations=1, **settings)
            how = self.blending(variant, given, nearest_subject)
            chosen = complete(case.seen, skins, network, given, blending=how)
            found["name"] = skins.names[int(np.argmax(chosen.blended.weights))]
        rows["nearest subject"] = skins.encoded(plain["name"])
        detail = with_complexion(
            jnp.asarray(skins.encoded(own["name"])), jnp.asarray(case.seen["low_frequency"]),
            self.side * COMPLEXION,
        )  # fmt: skip
        rows["nearest subject's detail on the complexion"] = np.asarray(detail)
        rows["before synthesis"] = done.start
        if variant.case != "oval":
            rows["mirrored (what is seen)"] = case.truth[:, ::-1]
        return {name: case.pasted(texture) for name, texture in rows.items()}


def agreement(bench: Bench, one: np.ndarray, other: np.ndarray) -> dict[str, float]:
    """Relative differences of the Grams of two textures over the whole face, by layer (fig. 9)."""
    case = bench.case("left")
    mask = jnp.asarray(case.hidden | case.shown)
    values = {}
    for name, network, layers in measuring_networks(bench.options.vgg):
        first, second = (
            inner_grams(network, rgb_to_yiq(jnp.asarray(x))[..., 0], mask, layers)
            for x in (one, other)
        )
        relative = [
            float(jnp.linalg.norm(first[k] - second[k]) / jnp.linalg.norm(first[k])) for k in layers
        ]
        values[f"Gram, {name}"] = float(np.mean(relative))
    return values


def sheet(path: Path, panels: list[np.ndarray], box: tuple[slice, slice]) -> None:
    """Cut-outs side by side, as a JPEG."""
    row = np.concatenate([panel[box] for panel in panels], axis=1)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((np.clip(row, 0, 1) * 255).round().astype(np.uint8)).save(path, quality=85)


def main() -> None:
    """Measure the variants asked for and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--real", type=Path, help="database with the scan (and imported skins)")
    parser.add_argument("--database", type=Path, help="procedural database of 32 subjects")
    parser.add_argument("--cache", type=Path, default=Path("/tmp/jaxface-quality-skins"))
    parser.add_argument("--vgg", type=Path, help="VGG-19 weights, to measure and to compare with")
    parser.add_argument("--only", default="", help="regular expression of 'group: name'")
    parser.add_argument("--side", type=int, default=SIDE)
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument("--sheets", type=Path, help="folder for pictures")
    parser.add_argument("--output", type=Path, default=RESULTS)
    options = parser.parse_args()
    jax.config.update("jax_compilation_cache_dir", None)
    bench = Bench(options)
    facts = dict(provenance(), side=options.side, iterations=options.iterations)
    # Sizes do not mix in one table: an octave of texels is another one of millimetres.
    size = "" if options.side == SIDE else f"_{options.side}"
    # Nor do runs of the few steps that rank choices, and of the many that the command takes.
    steps = f"_{options.iterations}_steps" if options.iterations > ITERATIONS else ""
    path = options.output / f"texture_quality{size}{steps}.json"

    def keep(group: str, name: str, values: dict[str, float]) -> None:
        write_results(path, group, name, values, facts)
        shown = ("Gram, random", "Gram, VGG-19", "power (octaves)", "patches", "colour (dE)")
        brief = ", ".join(f"{k} {values[k]:.3f}" for k in shown if k in values)
        print(f"{group}: {name}: {brief}", flush=True)

    views: dict[str, np.ndarray] = {}
    for variant in variants(options.vgg):
        if not re.search(options.only, f"{variant.group}: {variant.name}"):
            continue
        values, done, case = bench.complete(variant)
        keep(variant.group, variant.name, values)
        panels = [case.pasted(case.seen["low_frequency"]), done.start, done.albedo, case.truth]
        if variant.group == "core":
            for name, texture in bench.baselines(variant, done, case).items():
                keep("core", f"{name}, {variant.case}", bench.measured(texture, case))
                panels.insert(1, texture)
        views[variant.case] = done.albedo
        if variant.group == "views" and "left" in views:
            keep("views", "left against right", agreement(bench, views["left"], done.albedo))
        if options.sheets:
            word = re.sub(r"\W+", "-", f"{variant.group}-{variant.name}")
            sheet(options.sheets / f"{word}.jpg", panels, done.box)


if __name__ == "__main__":
    main()
