"""Style loss and gradient of VGG-19's shape to conv5_1, beside torch, whole and in tiles.

One call is the value of the Gram loss on five layers and its gradient with respect to a
one-channel image. Torch (``--torch PYTHON``, an interpreter that has torch) does the same work with
as many threads as there are cores. Every measurement is made in a process of its own, so that its
peak memory is its own; the programs take turns, and the best of all turns counts. *processor* is
the processor time of the best call: on a shared machine it says more than the clock.

Ours runs as in a synthesis by the command: the kernels' transforms are made once, and the process
keeps the memory that a call frees; so does torch's, which gains a fifth by it at 512 px.

*memory* is the peak resident size less that before the first call, when weights and image are
there and the program is compiled. The floor is the time of the multiplications alone, counted
as direct convolution, at the speed of this machine's matrix products.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from harness import Benchmark, Measurement

from jaxface.energies._gram import StyleData, StyleTargets, style_value_and_grad
from jaxface.networks.texture_features.network import STYLE_LAYERS, prepare_kernels
from jaxface.networks.texture_features.random_weights import SHAPES, random_network
from jaxface.run.memory import keep_freed_memory

WHOLE = (256, 512, 1024)
TILED = ((1024, 512), (2048, 1024), (4096, 1024), (8192, 1024))


def measure(side: int, tile: int | None, calls: int, method: str) -> dict[str, Any]:
    """Time calls in this process."""
    keep_freed_memory()
    network = random_network("vgg19")
    if tile is None and method == "auto":
        network = prepare_kernels(network, (side, side))
    image = jax.random.uniform(jax.random.key(0), (side, side))
    channels = network.channels
    targets = StyleTargets({name: jnp.ones((channels[name],) * 2) for name in STYLE_LAYERS})
    data = StyleData(network, targets)
    jax.block_until_ready((image, data))
    start = time.perf_counter()
    run = jax.jit(style_value_and_grad, static_argnames=("tile", "method"))
    program = run.lower(image, data, tile=tile, method=method).compile()
    compiled = time.perf_counter() - start
    before = resident()
    wall, processor = [], []
    for _ in range(calls):
        start = time.perf_counter(), time.process_time()
        jax.block_until_ready(program(image, data))
        wall.append(time.perf_counter() - start[0])
        processor.append(time.process_time() - start[1])
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return {
        "wall": wall,
        "processor": processor,
        "memory": peak - before,
        "compile": compiled,
    }


def resident() -> float:
    """Resident size of this process now, MB (Linux)."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def product_speed() -> float:
    """Multiply-adds a second of a large matrix product here."""
    x = jnp.ones((2048, 2048))
    product = jax.jit(jnp.matmul)
    best = min(_seconds(lambda: product(x, x)) for _ in range(8))
    return 2048**3 / best


def _seconds(function: Any) -> float:
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def multiply_adds(side: int) -> float:
    """Of loss and gradient by direct convolution, Gramians included."""
    total, channels = 0.0, 1
    for block, (count, width) in enumerate(SHAPES["vgg19"]):
        for place in range(count):
            both = 9 * channels * width + (width**2 if place == 0 else 0)
            total += 2 * both * (side / 2**block) ** 2
            channels = width
    return total


def in_process(command: list[str]) -> dict[str, Any]:
    """What a command says in the last line of its output."""
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


def best_of(turns: list[dict[str, Any]]) -> Measurement:
    """The best call over several turns; name and program are filled in by the caller."""
    wall = sorted(t for turn in turns for t in turn["wall"][1:] or turn["wall"])
    return Measurement(
        "",
        best=wall[0],
        median=wall[len(wall) // 2],
        compile=min(turn["compile"] for turn in turns),
        repeats=len(wall),
        values={
            "processor (s)": min(t for turn in turns for t in turn["processor"]),
            "memory (MB)": max(turn["memory"] for turn in turns),
        },
    )


def main() -> None:
    """Measure, compare and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--torch", metavar="PYTHON", help="an interpreter that has torch")
    parser.add_argument("--turns", type=int, default=3)
    parser.add_argument("--largest", type=int, default=4096, help="largest side, px")
    parser.add_argument("--smallest", type=int, default=0, help="smallest side, px")
    parser.add_argument("--one", nargs=4, metavar=("SIDE", "TILE", "CALLS", "METHOD"))
    options, remaining = parser.parse_known_args()
    if options.one:
        side, tile, calls = map(int, options.one[:3])
        print(json.dumps(measure(side, tile or None, calls, options.one[3])))
        return
    bench = Benchmark(f"features_from_{options.smallest}" if options.smallest else "features")
    sides = range(options.smallest, options.largest + 1)
    peer = [options.torch, str(Path(__file__).parent / "features_torch.py")]

    def ours(side: int, tile: int, calls: int, method: str = "auto") -> dict[str, Any]:
        arguments = ["--one", str(side), str(tile), str(calls), method]
        return in_process([sys.executable, __file__, *arguments])

    speed = product_speed()
    for side in (s for s in WHOLE if s in sides):
        calls = 4 if side < 1024 else 2
        turns: dict[str, list[dict[str, Any]]] = {"jaxface": [], "jaxface, direct": [], "torch": []}
        for _ in range(options.turns):
            turns["jaxface"].append(ours(side, 0, calls))
            if options.torch:
                turns["torch"].append(in_process([*peer, str(side), str(calls)]))
        if side < 1024:
            turns["jaxface, direct"].append(ours(side, 0, calls, "direct"))
        whole = {name: best_of(found) for name, found in turns.items() if found}
        for name, found in whole.items():
            values = dict(found.values, floor=multiply_adds(side) / speed)
            if "torch" in whole and name != "torch":
                values["of torch"] = (found.best or 0) / (whole["torch"].best or 1)
                mine, theirs = (whole[n].values["processor (s)"] for n in (name, "torch"))
                values["of torch, processor"] = mine / theirs
            bench.record(_named(found, f"{side} px", name, values))
    for side, tile in (pair for pair in TILED if pair[0] in sides):
        # The machine's speed drifts: what tiles cost is told against an image beside them.
        whole = [ours(1024, 0, 3)]
        found = best_of([ours(side, tile, 2 if side < 4096 else 1)])
        whole.append(ours(1024, 0, 3))
        values = dict(found.values)
        per_pixel = values["processor (s)"] / side**2
        values["processor per pixel (us)"] = per_pixel * 1e6
        values["times untiled, processor"] = per_pixel / (
            best_of(whole).values["processor (s)"] / 1024**2
        )
        bench.record(_named(found, f"{side} px in tiles of {tile}", "jaxface", values))
    bench.finish(remaining)


def _named(found: Measurement, name: str, program: str, values: dict[str, float]) -> Measurement:
    return Measurement(
        name, found.best, found.median, found.compile, found.repeats, program, values
    )


if __name__ == "__main__":
    main()
