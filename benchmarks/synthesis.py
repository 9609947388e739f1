"""Gram-loss synthesis (eq. 3 of Saito 2017) by each back end, and by torch's L-BFGS.

From the low frequencies of one painted skin towards the Gramians of another. Every program
minimises the same energy, of the same network, from the same start, for the same number of
evaluations of value and gradient, ours in the unknown that the synthesis has
(``stages.synthesise.changed``); what counts is how low it comes with them, and what one of them
costs. Ours run as by the command: the kernels' transforms are made once, and the process keeps the
memory that an evaluation frees; ``optax.lbfgs``, with its zoom search, runs beside them. An
evaluation's time is that of the run from its first to its last, over the number between: a program
with a line search of its own tells of evaluations when it pleases, several at once, so that
differences of neighbouring ones say nothing. Torch (``--torch PYTHON``, an interpreter that has
torch) is given its strong-Wolfe search, and none (its default), and the memory of ten pairs that
ours has.
"""

import argparse
import json
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax
from harness import Benchmark, Measurement
from held_out_skin import read_skins
from scipy.ndimage import gaussian_filter

from jaxface._types import Array, Float
from jaxface.energies._gram import StyleData, StyleTargets, grams, style_energy
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.io.feature_weights import load_network
from jaxface.networks.texture_features.network import FeatureNetwork, prepare_kernels
from jaxface.pipeline.databases.painted import synth_database
from jaxface.run.memory import keep_freed_memory
from jaxface.solvers._minimise import METHODS, minimise
from jaxface.stages.texture._synthesise import changed

MARKS = (25, 50, 100, 200)
"""evaluations after which the energy is noted, as a share of that at the start"""


def skins(side: int, folder: Path) -> tuple[Float[np.ndarray, "s s"], Float[np.ndarray, "s s"]]:
    """Start and example: low frequencies of one skin's intensity, and another skin's."""
    synth_database(folder, 2, 2 * side)
    read = read_skins(folder, side)
    one, other = (
        np.asarray(rgb_to_yiq(jnp.asarray(read.encoded(name)))[..., 0]) for name in read.names[:2]
    )
    return gaussian_filter(one, side / 64), other


class Evaluations:
    """Values of an energy, and the clocks, at each of its evaluations."""

    def __init__(self) -> None:
        self.values: list[float] = []
        self.wall: list[float] = []
        self.processor: list[float] = []

    def note(self, value: Any) -> None:
        """One more."""
        self.values.append(float(value))
        self.wall.append(time.perf_counter())
        self.processor.append(time.process_time())


def ours(
    energy: Callable[[Array, Any], Array], start: Array, data: Any, method: Any, limit: int
) -> dict[str, Any]:
    """By one of our back ends."""
    seen = Evaluations()

    def watched(y: Array, args: Any) -> Array:
        value = energy(y, args)
        jax.debug.callback(seen.note, value)
        return value

    # A jitted line search evaluates more than once a step; the longest run is cut below.
    minimise(watched, start, data, method=method, steps=limit, rtol=0.0)
    jax.effects_barrier()
    return {key: value[:limit] for key, value in vars(seen).items()}


def by_optax(
    energy: Callable[[Array, Any], Array], start: Array, data: Any, limit: int
) -> dict[str, Any]:
    """By ``optax.lbfgs``, a step at a time."""
    seen = Evaluations()

    def watched(y: Array, data: Any) -> Array:
        value = energy(y, data)
        jax.debug.callback(seen.note, value)
        return value

    solver = optax.lbfgs(memory_size=10)

    @jax.jit
    def step(y: Array, state: Any, data: Any) -> tuple[Array, Any]:
        value, gradient = optax.value_and_grad_from_state(watched)(y, data=data, state=state)
        updates, state = solver.update(
            gradient, state, y, value=value, grad=gradient, value_fn=watched, data=data
        )
        return y + updates, state

    y, state = start, solver.init(start)
    for _ in range(limit):
        y, state = jax.block_until_ready(step(y, state, data))
        jax.effects_barrier()
        if len(seen.values) >= limit:
            break
    return {key: value[:limit] for key, value in vars(seen).items()}


def measurement(program: str, name: str, found: dict[str, Any], goal: float) -> Measurement:
    """What a run says: the cost of an evaluation, and how far they brought it."""
    values, wall, processor = (np.array(found[k]) for k in ("values", "wall", "processor"))
    lowest = np.minimum.accumulate(np.nan_to_num(values, nan=np.inf)) / values[0]
    reached = np.flatnonzero(lowest <= goal)
    figures = {f"after {m}": float(lowest[m - 1]) for m in MARKS if m <= len(values)}
    figures["to torch's last"] = float(reached[0] + 1) if len(reached) else float("nan")
    between = max(len(values) - 1, 1)
    figures["processor (s)"] = float(processor[-1] - processor[0]) / between
    return Measurement(
        name,
        best=float(wall[-1] - wall[0]) / between,
        repeats=len(values),
        program=program,
        values=figures,
    )


def write_problem(path: Path, network: FeatureNetwork, start: Array, targets: StyleTargets) -> None:
    """The problem for a program that is not ours."""
    arrays = {f"kernel_{k}": v for k, v in network.kernels.items()}
    arrays |= {f"bias_{k}": v for k, v in network.biases.items()}
    arrays |= {f"gram_{k}": v for k, v in targets.grams.items()}
    arrays |= {"start": start, "alpha": jnp.asarray(targets.alpha)}
    np.savez(path, **{name: np.asarray(value, np.float32) for name, value in arrays.items()})


def main() -> None:
    """Measure, compare and write the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--torch", metavar="PYTHON", help="an interpreter that has torch")
    parser.add_argument("--side", type=int, default=256)
    parser.add_argument("--evaluations", type=int, help="of each run; fewer for a first look")
    parser.add_argument("--only", choices=("random", "random-vgg19"))
    options, remaining = parser.parse_known_args()
    keep_freed_memory()
    bench = Benchmark(
        "synthesis", packages=("jax", "jaxlib", "jaxopt", "optax", "optimistix", "numpy")
    )
    with tempfile.TemporaryDirectory() as temporary:
        low, example = skins(options.side, Path(temporary) / "skins")
        start = jnp.arctanh(2 * jnp.clip(jnp.asarray(low), 0.004, 0.996) - 1)
        for network_name, limit in (("random", 200), ("random-vgg19", 50)):
            if options.only not in (None, network_name):
                continue
            limit = options.evaluations or limit
            network = load_network(network_name)
            targets = StyleTargets(jax.jit(grams)(jnp.asarray(example), network))

            def energy(z: Array, data: tuple[FeatureNetwork, StyleTargets, Array]) -> Array:
                return style_energy(changed(data[2], z), StyleData(data[0], data[1]))

            name = f"{network_name}, {options.side} px"
            runs: dict[str, dict[str, Any]] = {}
            if options.torch:
                problem = Path(temporary) / "problem.npz"
                write_problem(problem, network, start, targets)
                for search in ("strong_wolfe", "none"):
                    command = [options.torch, str(Path(__file__).parent / "synthesis_torch.py")]
                    command += [str(problem), str(limit), search]
                    done = subprocess.run(command, capture_output=True, text=True, check=True)
                    answer = json.loads(done.stdout.strip().splitlines()[-1])
                    runs[f"torch, {search}"] = {k: v[:limit] for k, v in answer.items()
                                                if isinstance(v, list)}  # fmt: skip
            data = (prepare_kernels(network, low.shape), targets, jnp.asarray(low))
            # Jitted line searches hold the network many times over: minutes to compile.
            for method in METHODS if network_name == "random" else ("lbfgs",):
                runs[f"jaxface, {method}"] = ours(
                    energy,
                    jnp.zeros_like(start),
                    data,
                    method,
                    limit,
                )
            if network_name == "random":
                runs["optax, lbfgs"] = by_optax(energy, jnp.zeros_like(start), data, limit)
            lasts = [min(r["values"]) / r["values"][0] for k, r in runs.items() if "torch" in k]
            goal = min(lasts, default=0.0)
            for program, found in runs.items():
                bench.record(measurement(program, name, found, goal))
    bench.finish(remaining)


if __name__ == "__main__":
    main()
