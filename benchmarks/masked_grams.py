"""Gram matrices of a masked texture: from the cache, and by running the network again.

1024x1024 noise with the spectrum of natural images; masks: an ellipse, half of it, and the ellipse
with holes for eyes, nostrils and mouth. Both ways run in turn in one process, a texture at a time;
preparing the mask, once for the whole database, is a line of its own.
"""

import sys
import time

import jax
import jax.numpy as jnp
import numpy as np
from harness import Benchmark, Measurement

from jaxface.energies.gram import grams, mask_out
from jaxface.io.feature_weights import load_network
from jaxface.models.random_features import natural_noise
from jaxface.stages.masked_grams import compressed, layout, masked_grams_of, prepare, store

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


def best(function, repeats):
    """Shortest wall and processor time, and the last result."""
    wall, processor = np.inf, np.inf
    for _ in range(repeats):
        start, cpu = time.perf_counter(), time.process_time()
        result = jax.block_until_ready(function())
        wall = min(wall, time.perf_counter() - start)
        processor = min(processor, time.process_time() - cpu)
    return wall, processor, result


def main() -> None:
    bench = Benchmark("masked_grams")
    face = disc(50, 50, 33, 42)
    masks = {"ellipse": face, "half": face & (np.arange(SIDE) < SIDE // 2)}
    masks["ellipse with holes"] = face & ~np.any([disc(*hole) for hole in HOLES], axis=0)
    image = jnp.asarray(natural_noise(SIDE, np.random.default_rng(0)), jnp.float32)
    for source in [a for a in sys.argv[1:] if not a.startswith("-")] or ["random"]:
        network = load_network(source)
        plan = layout(network, (SIDE, SIDE))
        stored = compressed(jax.jit(lambda n, i, p=plan: store(n, i, p))(network, image), plan)
        direct = jax.jit(lambda n, i, v: grams(n, mask_out(i, v)))
        for name, mask in masks.items():
            visible = jnp.asarray(mask)
            once = best(lambda m=mask, n=network, p=plan: prepare(n, m, p), 1)
            jax.block_until_ready(direct(network, image, visible))
            run = lambda n=network, v=visible, d=direct: d(n, image, v)  # noqa: E731
            whole = best(run, 3)
            masked_grams_of(once[2], stored)
            part = best(lambda p=once[2], s=stored: masked_grams_of(p, s), 6)
            error = max(
                float(np.linalg.norm(part[2][k] - whole[2][k]) / np.linalg.norm(whole[2][k]))
                for k in part[2]
            )
            values = {"processor (s)": part[1], "times faster (processor)": whole[1] / part[1]}
            values |= {"times faster (wall)": whole[0] / part[0], "largest error": error}
            values["MB a texture"] = plan.bytes / 1e6
            title = f"{source}, {name}"
            network_again = {"processor (s)": whole[1]}
            bench.record(Measurement(f"{title}: network again", whole[0], values=network_again))
            bench.record(Measurement(f"{title}: from the cache", part[0], values=values))
            bench.record(Measurement(f"{title}: prepare the mask, compiling", once[0]))
    bench.finish([a for a in sys.argv[1:] if a.startswith("-")])


if __name__ == "__main__":
    main()
