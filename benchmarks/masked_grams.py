"""Gram matrices of a database's masked textures: from the cache, and by running the network again.

1024x1024 noise with the spectrum of natural images; masks: an ellipse, half of it, the ellipse with
holes for eyes, nostrils and mouth, and what photos show, which `digitize` writes. Both ways run in
turn in one process, a texture at a time; then the whole database behind each mask, from files.

    jaxface digitize demo --resolution 1024 -o astronaut
    python benchmarks/masked_grams.py random --textures 64 --mask astronaut/visibility.png
    python benchmarks/masked_grams.py random-vgg19 --textures 64 --folder /tmp/grams
"""

import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
import skimage.io
import typer
from harness import Benchmark, Measurement
from threadpoolctl import threadpool_limits

from jaxface.energies._gram import grams, mask_out
from jaxface.io.feature_weights import load_network
from jaxface.io.texture_database import Subject
from jaxface.networks.texture_features.random_weights import natural_noise
from jaxface.pipeline.databases.grams import intensity, masked_grams, precompute
from jaxface.run.memory import keep_freed_memory
from jaxface.stages.texture.masked_grams import compressed, layout, masked_grams_of, prepare, store

SIDE = 1024
HOLES = (
    (36, 42, 7, 3.5),
    (64, 42, 7, 3.5),
    (46, 60, 1.5, 1.2),
    (54, 60, 1.5, 1.2),
    (50, 72, 10, 3),
)


def disc(x, y, a, b):
    rows, columns = np.mgrid[:SIDE, :SIDE] * (100 / SIDE)
    return ((columns - x) / a) ** 2 + ((rows - y) / b) ** 2 < 1


def masks(photos: Sequence[Path]) -> dict[str, np.ndarray]:
    """By name; those of photos are called after their files' folders."""
    face = disc(50, 50, 33, 42)
    holes = np.any([disc(*hole) for hole in HOLES], axis=0)
    found = {
        "ellipse": face,
        "half": face & (np.arange(SIDE) < SIDE // 2),
        "ellipse with holes": face & ~holes,
    }
    for path in photos:
        shown = skimage.io.imread(path)
        if shown.shape != face.shape:
            raise SystemExit(f"{path} has shape {shown.shape}, not {face.shape}")
        found[path.resolve().parent.name] = shown >= 128
    return found


class Timer:
    """Wall and processor time of what runs inside."""

    def __enter__(self):
        self.wall, self.processor = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *_):
        self.wall = time.perf_counter() - self.wall
        self.processor = time.process_time() - self.processor
        self.both = np.array([self.wall, self.processor])


def best(function, repeats):
    """Shortest wall and processor time, and the last result."""
    timers, result = [], None
    for _ in range(repeats):
        with Timer() as timer:
            result = jax.block_until_ready(function())
        timers.append(timer)
    return min(t.wall for t in timers), min(t.processor for t in timers), result


def largest_error(found, true) -> float:
    return max(float(np.linalg.norm(found[k] - true[k]) / np.linalg.norm(true[k])) for k in found)


def one_texture(bench: Benchmark, source: str, network, direct, behind) -> None:
    """Every mask, a texture whose cache is in memory."""
    plan = layout(network, (SIDE, SIDE))
    image = jnp.asarray(natural_noise(SIDE, np.random.default_rng(0)), jnp.float32)
    stored = compressed(jax.jit(lambda n, i: store(n, i, plan))(network, image), plan)
    for name, mask in behind.items():
        visible = jnp.asarray(mask)
        prepare(network, mask, plan)  # compiles
        once = best(lambda m=mask: prepare(network, m, plan), 2)
        jax.block_until_ready(direct(network, image, visible))
        masked_grams_of(once[2], stored)
        # In turn, so that what else the machine does meets both.
        whole, part = [np.inf, np.inf], [np.inf, np.inf]
        for _ in range(3):
            again = best(lambda v=visible: direct(network, image, v), 1)
            with threadpool_limits(1, "blas"):
                ours = best(lambda p=once[2]: masked_grams_of(p, stored), 4)
            whole = np.minimum(whole, again[:2])
            part = np.minimum(part, ours[:2])
        gain = {
            "times faster (processor)": whole[1] / part[1],
            "times faster (wall)": whole[0] / part[0],
            "largest error": largest_error(ours[2], again[2]),
            "MB a texture": plan.bytes / 1e6,
        }
        title = f"{source}, {name}"
        record(bench, f"{title}: network again", whole)
        record(bench, f"{title}: from the cache", part, gain)
        record(bench, f"{title}: prepare the mask", once)


class Noise:
    """What `precompute` uses of a database: textures of noise, made when they are asked for."""

    resolution = SIDE

    def __init__(self, path: Path, count: int):
        self.path = path
        self.names = tuple(f"n{index}" for index in range(count))
        self.subjects = [Subject(name, f"{name}.png", "CC0-1.0") for name in self.names]

    def __len__(self) -> int:
        return len(self.names)

    def stamp(self, name: str) -> str:
        return f"noise of {SIDE} px"

    def encoded(self, name: str) -> np.ndarray:
        plane = natural_noise(SIDE, np.random.default_rng([1, int(name[1:])]))
        return np.repeat(plane[..., None].astype(np.float32), 3, axis=-1)


def whole_database(
    bench: Benchmark, source: str, network, direct, behind, count: int, folder: Path, again: int
) -> None:
    """All textures behind every mask, the mask's preparation and the reading included."""
    database: Any = Noise(folder, count)
    title = f"{source}, {count} textures"
    with Timer() as building:
        cache = precompute(database, network)
    record(bench, f"{title}: build the cache", building.both)
    if hasattr(os, "sync"):
        os.sync()  # what the system still writes of the cache would slow down what is timed
    images = [jnp.asarray(intensity(database.encoded(n), SIDE)) for n in database.names[:again]]
    jax.block_until_ready(direct(network, images[0], jnp.ones((SIDE, SIDE), bool)))
    with Timer() as first:
        masked_grams(replace(cache, keys=cache.keys[:1]), next(iter(behind.values())))
    record(bench, f"{title}: first mask of a process", first.both)
    for name, mask in behind.items():
        # In turn, so that what else the machine does meets both.
        ours, network_again = np.zeros(2), np.zeros(2)
        found, error = {}, 0.0
        for half in np.array_split(np.arange(len(images)), 2):
            with Timer() as timer:
                found = masked_grams(cache, mask)
            ours += timer.both / 2
            visible = jnp.asarray(mask)
            with Timer() as timer:
                true = [jax.block_until_ready(direct(network, images[i], visible)) for i in half]
            network_again += timer.both * count / len(images)
            for index, one in zip(half, true, strict=True):
                error = max(error, largest_error({k: v[index] for k, v in found.items()}, one))
        timed = "" if len(images) == count else f" ({len(images)} timed)"
        record(bench, f"{title}, {name}: network again{timed}", network_again)
        gain = {
            "times faster (processor)": network_again[1] / ours[1],
            "times faster (wall)": network_again[0] / ours[0],
            "largest error": error,
            "MB a texture": cache.layout.bytes / 1e6,
        }
        record(bench, f"{title}, {name}: from the cache", ours, gain)


def record(bench: Benchmark, name: str, times, values: Mapping[str, float] | None = None) -> None:
    """Wall and processor time of what was timed, and what else was measured."""
    values = {"processor (s)": float(times[1]), **(values or {})}
    bench.record(Measurement(name, float(times[0]), values=values))


def main(
    source: Annotated[str, typer.Argument(help="network, as of --features")] = "random",
    textures: Annotated[int, typer.Option(help="of the database; 0: single ones only")] = 64,
    again: Annotated[int, typer.Option(help="textures that the network is run on again")] = 64,
    folder: Annotated[Path | None, typer.Option(help="of the cache, temporary if absent")] = None,
    mask: Annotated[list[Path] | None, typer.Option(help="a visibility.png of 1024 px")] = None,
    name: Annotated[str, typer.Option(help="of the results")] = "masked_grams",
) -> None:
    keep_freed_memory()  # as the command does; both ways gain by it
    bench = Benchmark(name)
    network = load_network(source)
    direct = jax.jit(lambda n, i, v: grams(mask_out(i, v), n))
    behind = masks(mask or [])
    one_texture(bench, source, network, direct, behind)
    if textures:
        with tempfile.TemporaryDirectory() as temporary:
            place, again = folder or Path(temporary), min(again, textures)
            whole_database(bench, source, network, direct, behind, textures, place, again)
    bench.finish([])


if __name__ == "__main__":
    typer.run(main)
