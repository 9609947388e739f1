"""Texture synthesis by matching Gram matrices (Saito 2017, section 5, equation 3).

The intensity of every free texel is sought so that the feature statistics of the texture are the
target's, coarse to fine in resolution.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Bool, Float
from jaxface.energies._gram import MASKED, StyleData, StyleTargets, style_energy
from jaxface.energies.known_detail import KnownDetail, photo_detail_energy, plain_detail_energy
from jaxface.energies.term import Energy, Term, compose
from jaxface.imaging.spectrum import inverse_frequency
from jaxface.networks.texture_features.network import FeatureNetwork, prepare_kernels
from jaxface.solvers._minimise import Method, minimise
from jaxface.solvers.lbfgs import LBFGSState


class SynthesisWeights(eqx.Module):
    """Weights of the terms beside eq. 3, whose alpha is in the targets."""

    photo: float | Array = 30.0
    """of staying with what the photo shows; 0 gives the paper's energy"""
    plain: float | Array = 30.0
    """of staying with the low frequencies where the detail map is below 1"""


class SynthesisProblem(eqx.Module):
    """One level of a synthesis."""

    network: FeatureNetwork
    targets: StyleTargets
    free: Bool[Array, "h w"]
    """texels to find; the others are ``MASKED`` for the statistics, as in the targets'"""
    known: KnownDetail
    weights: SynthesisWeights


class Synthesis(NamedTuple):
    """A synthesised intensity.

    Attributes:
        image: (h, w), in (0, 1) where free, the start elsewhere.
        values: energy before the first step and after each.
        terms: the weighted energy of each term at the end.
        evaluations: of energy and gradient.
        state: of the solver, to go on from.
    """

    image: Float[Array, "h w"]
    values: list[float]
    terms: dict[str, float]
    evaluations: int
    state: LBFGSState | None


def synthesis_energy(tile: int | None = None, method: str = "auto") -> Energy:
    """Equation 3 and the known detail as composed terms of ``(image, SynthesisProblem)``.

    They are ``style``, ``photo`` and ``plain``; the weights of the last two are in the problem.

    Args:
        tile: where given, statistics are summed over tiles of this side (see ``energies.gram``).
        method: of the convolutions.
    """

    def style(image: Array, problem: SynthesisProblem) -> Array:
        shown = jnp.where(problem.free, image, jnp.asarray(MASKED, image.dtype))
        data = StyleData(problem.network, problem.targets)
        return style_energy(shown, data, tile=tile, method=method)

    def held(image: Array, problem: SynthesisProblem) -> Array:
        return jnp.where(problem.free, image, problem.known.low_frequency)

    def photo(image: Array, problem: SynthesisProblem) -> Array:
        return photo_detail_energy(held(image, problem), problem.known)

    def plain(image: Array, problem: SynthesisProblem) -> Array:
        return plain_detail_energy(held(image, problem), problem.known)

    return compose(
        [
            Term("style", style, 1.0, "scalar"),
            Term("photo", photo, lambda problem: problem.weights.photo, "scalar"),
            Term("plain", plain, lambda problem: problem.weights.plain, "scalar"),
        ]
    )


def synthesise(
    start: Float[Array, "h w"],
    problem: SynthesisProblem,
    *,
    steps: int = 100,
    method: Method = "lbfgs",
    tile: int | None = None,
    convolution: str = "auto",
    rtol: float = 1e-4,
    on_step: Callable[[int, float, Callable[[], Array]], bool | None] | None = None,
) -> Synthesis:
    """Minimise equation 3 (and the known detail) over the free texels, by L-BFGS.

    Intensities stay within (0, 1); the unknown is the change of `changed`.

    Args:
        start: first intensities; the low-frequency albedo in the paper.
        problem: network, targets, free texels, known detail.
        steps: greatest number of L-BFGS steps.
        method: back end, see ``solvers.minimise``.
        tile: side of the tiles in which statistics are summed, where memory must be bounded.
        convolution: see ``models.conv3x3``.
        rtol: stops when ten steps together gain less than this part of the energy.
        on_step: called after each step with its number, the energy, and a function that gives the
            image so far; True stops.

    Raises:
        ValueError: shapes differ, or the start is not finite.
    """
    if not start.shape == problem.free.shape == problem.known.photo.shape:
        raise ValueError(
            f"start is {start.shape}, free {problem.free.shape}, the photo "
            f"{problem.known.photo.shape}; they must be of one shape"
        )
    if not bool(jnp.all(jnp.isfinite(start))):
        raise ValueError("the start of the synthesis has values that are not finite")
    energy = synthesis_energy(tile, convolution)
    if convolution == "auto" and (tile is None or max(start.shape) <= tile):
        network = prepare_kernels(problem.network, (start.shape[0], start.shape[1]))
        problem = eqx.tree_at(lambda p: p.network, problem, network)

    def of_change(change: Array, args: tuple[Array, SynthesisProblem]) -> Array:
        start, problem = args
        return energy.value(changed(start, change, problem.known.detail), problem)[0]

    def within(change: Array) -> Array:
        return jnp.where(problem.free, changed(start, change, problem.known.detail), start)

    def watch(step: int, state: LBFGSState) -> bool | None:
        def image() -> Array:
            return within(state.y.reshape(start.shape))

        return None if on_step is None else on_step(step, float(state.value), image)

    hooks: dict[str, Any] = {}
    if method == "lbfgs" and on_step is not None:
        hooks["on_step"] = watch
    found = minimise(
        of_change, jnp.zeros_like(start), (start, problem),
        method=method, steps=steps, rtol=rtol, **hooks,
    )  # fmt: skip
    image = within(found.value)
    terms = jax.jit(energy.value)(image, problem)[1]
    return Synthesis(
        image,
        found.stats.get("values", []),
        {name: float(value) for name, value in terms.items()},
        int(found.stats.get("evaluations", 0)),
        found.stats.get("state"),
    )


def changed(
    start: Float[Array, "h w"],
    change: Float[Array, "h w"],
    detail: Float[Array, "h w"] | float = 1.0,
) -> Float[Array, "h w"]:
    """Intensities in (0, 1): ``(1 + tanh(artanh(2 start - 1) + detail * B change)) / 2``.

    Where the detail map is 0 the start stays as it is. ``B`` scales frequencies by their inverse
    (``imaging.spectrum``): a preconditioner. The energy is far less curved along low frequencies,
    of which a Gramian sees the little that leaves the receptive field, than along high ones; with
    it half of the evaluations, and fewer, reach the same energy. Below its offset ``B`` is level,
    so that the complexion, which the low-frequency albedo gives, is not what moves first.
    """
    first = jnp.arctanh(2 * jnp.clip(start, 0.004, 0.996) - 1)
    return 0.5 + 0.5 * jnp.tanh(first + detail * inverse_frequency(change))
