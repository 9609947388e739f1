"""A new picture of a texture, from an exemplar of it (Gatys et al. 2015), coarse to fine.

The picture is sought whose statistics are the exemplar's (`energies.exemplar`), at the coarsest
size from noise, at each next one from the picture before. Its size is free.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Shaped
from jaxface.energies.exemplar import (
    HISTOGRAM_WEIGHT,
    SMALLEST_MAP,
    ExemplarTargets,
    ExemplarWeights,
    exemplar_energy,
    exemplar_targets,
    least_side,
)
from jaxface.energies.term import Energy
from jaxface.imaging.colour_axes import ColourAxes, colour_axes, to_channels
from jaxface.imaging.pyramid import pyramid
from jaxface.imaging.resample import resize
from jaxface.imaging.spectrum import inverse_frequency
from jaxface.networks.texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    blocks_up_to,
    prepare_kernels,
)
from jaxface.solvers._minimise import Method, minimise

Picture = Shaped[Array, "h w *c"] | Shaped[np.ndarray, "h w *c"]

COARSEST = 32
"""px: exemplar and texture are halved while their shorter sides stay at least so long"""

_EDGE = 1e-4
"""how near to black and white a start may be, so that it can still leave them"""


class TextureSynthesis(NamedTuple):
    """A synthesised texture.

    Attributes:
        texture: sRGB-encoded, within 0 and 1; of the exemplar's channels.
        values: of each level, coarsest first: the energy before the first step and after each.
        terms: weighted energy of each term at the end.
        sizes: (h, w) of each level.
        evaluations: of energy and gradient, on each level.
    """

    texture: Float[Array, "h w c"]
    values: tuple[tuple[float, ...], ...]
    terms: dict[str, float]
    sizes: tuple[tuple[int, int], ...]
    evaluations: tuple[int, ...]


def synthesise_texture(
    image: Picture,
    network: FeatureNetwork,
    *,
    layers: Sequence[str] | None = None,
    alpha: float = 1.0,
    size: int | tuple[int, int] | None = None,
    histogram: float = HISTOGRAM_WEIGHT,
    octaves: int = 4,
    steps: int = 200,
    seed: int = 0,
    method: Method = "lbfgs",
    on_step: Callable[[int, int], bool | None] | None = None,
) -> TextureSynthesis:
    """A new picture of an exemplar's texture.

    The same arguments give the same picture. Memory grows with the pixels of the texture, for it is
    not cut into tiles: about 1 kB a pixel and colour axis with `random` and `trained`, 2.2 kB with
    three blocks of VGG-19.

    Args:
        image: the exemplar, sRGB-encoded, 0 to 1; (h, w), (h, w, 1) or (h, w, 3).
        network: `io.feature_weights.load_network` reads one.
        layers: names of those whose Gramians are matched; by default the first of each block, as
            far as the network has them and the exemplar is large enough.
        alpha: weight of the Gramians against the histogram. A picture whose Gramians are 0 has
            the energy alpha, with every network.
        size: of the texture, px: (h, w), or one number for a square; by default the exemplar's.
        histogram: weight of the distribution of colours.
        octaves: sizes at which the network sees the picture: whole, halved, and so on.
        steps: of the solver, on each level at most.
        seed: of the noise that it starts from.
        method: back end, see ``solvers.minimise``.
        on_step: called after each step with the steps done and those of all levels; True ends a
            level. Method ``lbfgs`` only.

    Raises:
        ValueError: the exemplar is no picture, not finite, not within 0 and 1, the same everywhere
            or too small; the network lacks a layer; a size, weight or number of steps is not
            positive.
    """
    exemplar = _checked(image)
    height, width = exemplar.shape[:2]
    shape = _size(size, (height, width))
    for name, value in (("alpha", alpha), ("histogram", histogram)):
        if not (np.isfinite(value) and value >= 0):
            raise ValueError(f"{name} is {value}; a finite number of at least 0 is needed")
    if alpha == histogram == 0:
        raise ValueError("alpha and histogram are 0; at least one must be positive")
    if steps < 1 or octaves < 1:
        raise ValueError(f"steps is {steps} and octaves {octaves}; at least 1 is needed of both")
    names = _layers(network, layers, (height, width))
    weights = ExemplarWeights(alpha, histogram)
    energy = exemplar_energy(histogram > 0)
    network = jax.tree.map(lambda x: jnp.asarray(x, exemplar.dtype), network)
    colours = jax.tree.map(lambda x: jnp.asarray(x, exemplar.dtype), colour_axes(exemplar))

    coarsest = max(COARSEST, least_side(names))
    if min(shape) < coarsest:
        raise ValueError(f"size is {size}; with layers {names} at least {coarsest} px are needed")
    count = 1 + int(np.log2(min(height, width, *shape) / coarsest))
    exemplars = pyramid(exemplar, count)
    image_so_far: Array | None = None
    levels: list[_Level] = []
    for level in reversed(range(count)):
        here = -(-shape[0] // 2**level), -(-shape[1] // 2**level)
        smaller = exemplars[level]
        targets = exemplar_targets(network, smaller, names, octaves, weights, colours, here)
        if image_so_far is None:
            start = _noise(smaller, colours, here, seed)
        else:
            start = resize(_unbounded(image_so_far), *here)
        done = steps * len(levels)

        def watch(step: int, done: int = done) -> bool | None:
            return None if on_step is None else on_step(done + step, steps * count)

        hook = watch if on_step is not None and method == "lbfgs" else None
        levels.append(_solve(energy, start, targets, steps, method, hook))
        image_so_far = levels[-1].image
    last = levels[-1]
    terms = jax.jit(energy.value)(last.image, last.targets)[1]
    return TextureSynthesis(
        last.image,
        tuple(level.values for level in levels),
        {name: float(value) for name, value in terms.items()},
        tuple((level.image.shape[0], level.image.shape[1]) for level in levels),
        tuple(level.evaluations for level in levels),
    )


class _Level(NamedTuple):
    image: Array
    values: tuple[float, ...]
    targets: ExemplarTargets
    evaluations: int


def _solve(
    energy: Energy,
    start: Float[Array, "h w c"],
    targets: ExemplarTargets,
    steps: int,
    method: Method,
    on_step: Callable[[int], bool | None] | None,
) -> _Level:
    shape = start.shape[0], start.shape[1]
    # Many images of one shape; kept for this level alone, for it is large.
    prepared = prepare_kernels(targets.network, shape)
    ready = eqx.tree_at(lambda t: t.network, targets, prepared)

    def of_change(change: Array, args: tuple[Array, ExemplarTargets]) -> Array:
        start, targets = args
        return energy.value(_bounded(start, change, targets.colours), targets)[0]

    hooks: dict[str, Any] = {}
    if on_step is not None:
        hooks["on_step"] = lambda step, state: on_step(step)
    unknown = jnp.zeros((*shape, targets.colours.axes.shape[0]), start.dtype)
    found = minimise(of_change, unknown, (start, ready), method=method, steps=steps, **hooks)
    image = _bounded(start, found.value, targets.colours)
    return _Level(
        image,
        tuple(found.stats.get("values", ())),
        targets,
        int(found.stats.get("evaluations", 0)),
    )


@jax.jit
def _bounded(
    start: Float[Array, "h w c"], change: Float[Array, "h w k"], colours: ColourAxes
) -> Float[Array, "h w c"]:
    """``(1 + tanh(start + sum_c a_c B change_c)) / 2``: intensities within 0 and 1.

    ``a_c`` are the exemplar's colour axes, so that a grey texture stays grey; ``B`` scales
    frequencies by their inverse (``imaging.spectrum``), a preconditioner.
    """
    smooth = jax.vmap(inverse_frequency, -1, -1)(change)
    return 0.5 + 0.5 * jnp.tanh(start + jnp.einsum("hwk,kc->hwc", smooth, colours.axes))


def _unbounded(image: Float[Array, "h w c"]) -> Float[Array, "h w c"]:
    return jnp.arctanh(2 * jnp.clip(image, _EDGE, 1 - _EDGE) - 1)


def _noise(
    exemplar: Float[Array, "h w c"], colours: ColourAxes, shape: tuple[int, int], seed: int
) -> Float[Array, "h w c"]:
    """White noise around the exemplar's mean, as strong as its colours vary."""
    spread = jnp.std(to_channels(exemplar, colours), axis=(0, 1)) / colours.gains
    noise = jax.random.normal(jax.random.key(seed), (*shape, len(spread)), exemplar.dtype)
    # Of tanh's argument, which changes twice as fast as the intensity in its middle.
    coloured = jnp.einsum("hwk,kc->hwc", 2 * noise * spread, colours.axes)
    return jnp.mean(_unbounded(exemplar), axis=(0, 1)) + coloured


def _checked(image: Picture) -> Float[Array, "h w c"]:
    values = np.asarray(image)
    if values.ndim == 2:
        values = values[..., None]
    if values.ndim != 3 or values.shape[2] not in (1, 3):
        raise ValueError(
            f"image has shape {np.shape(image)}; (h, w), (h, w, 1) or (h, w, 3) is needed"
        )
    if min(values.shape[:2]) < COARSEST:
        raise ValueError(
            f"image has {values.shape[0]}x{values.shape[1]} px; at least {COARSEST} are needed "
            "along each side"
        )
    if not np.isfinite(values).all():
        raise ValueError("image has values that are not finite")
    if values.min() < 0 or values.max() > 1:
        raise ValueError(
            f"image has values from {values.min():g} to {values.max():g}; needed are sRGB-encoded "
            "values within 0 and 1 (divide 8-bit values by 255)"
        )
    if np.ptp(values, axis=(0, 1)).max() < 1e-3:
        raise ValueError("image is the same everywhere; it has no texture")
    return jnp.asarray(values, jnp.result_type(float))


def _size(size: int | tuple[int, int] | None, own: tuple[int, int]) -> tuple[int, int]:
    shape = own if size is None else (size, size) if isinstance(size, int) else tuple(size)
    if len(shape) != 2 or min(shape) < COARSEST or any(int(side) != side for side in shape):
        raise ValueError(
            f"size is {size}; needed is (height, width) or one side, whole numbers of at least "
            f"{COARSEST} px"
        )
    return int(shape[0]), int(shape[1])


def _layers(
    network: FeatureNetwork, layers: Sequence[str] | None, shape: tuple[int, int]
) -> tuple[str, ...]:
    if layers is None:
        return tuple(name for name in STYLE_LAYERS if name in network.kernels)
    names = tuple(layers)
    blocks = len(blocks_up_to(network, names))
    if min(shape) < SMALLEST_MAP << (blocks - 1):
        raise ValueError(
            f"image has {shape[0]}x{shape[1]} px; for the layers {names} at least "
            f"{SMALLEST_MAP << (blocks - 1)} are needed along each side"
        )
    return names
