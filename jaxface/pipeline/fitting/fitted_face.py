"""What a fit is: the unknowns found, the model, the photo they explain, and how sure they are."""

import dataclasses
import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._compilation import quick_compilation
from jaxface._types import Array, Float
from jaxface.energies.term import Energy
from jaxface.models.landmark_schemes import landmarks68
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.models.parameters import FaceParameters, set_apart
from jaxface.run.clock import Clock
from jaxface.stages.fit import (
    FitConfig,
    FitData,
    FitModel,
    FitRender,
    FitStats,
    Posterior,
    WorkingPhoto,
    brow_map,
    fit_energy,
    no_history,
    observe_finest,
    posterior,
    render_fit,
    skin_map,
    weights_as_data,
)
from jaxface.stages.fit.options import FitOptions


@dataclass(frozen=True, eq=False)
class FittedFace:
    """A photo, the model, and what the fit found.

    What is made of these (the render, the map of skin, the posterior) is made when it is first
    asked for, and kept.
    """

    photo: Float[np.ndarray, "h w 3"]
    """linear RGB"""
    working: WorkingPhoto
    landmarks: Float[np.ndarray, "l 2"]
    """detected or given, px of the photo"""
    models: tuple[FitModel, ...]
    """level of detail for each pyramid level; the last is the finest"""
    parameters: FaceParameters
    stats: FitStats = field(default_factory=no_history)
    options: FitOptions = field(default_factory=FitOptions)
    """with which it was fitted"""
    landmark_depth: Float[np.ndarray, "l"] | None = None
    """of each landmark, px of the photo, smaller nearer to the camera, against the others alone;
    None where the landmarks came without"""
    _kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def model(self) -> MorphableModel:
        """The finest level of detail."""
        return self.models[-1].model

    @property
    def vertices(self) -> Float[Array, "n 3"]:
        """Fitted shape in the model's frame, mm."""
        return self._once("vertices", None, _shape_program, self.model, self.parameters)

    @property
    def size(self) -> int:
        """Side of the working image, px."""
        return self.working.data.image.shape[0]

    @property
    def fitted_landmarks(self) -> Float[np.ndarray, "l 2"]:
        """Where the fitted mesh has the landmarks, px of the photo (contours not slid)."""
        finest, principal = self.models[-1], self.working.data.principal
        args = (finest.model, finest.points, self.parameters, principal)
        points = self._once("landmarks", None, _landmark_program, *args)
        return self.working.crop.to_photo(np.asarray(points))

    @property
    def posterior(self) -> Posterior:
        """How sure the fit is.

        Raises:
            ValueError: there is no curvature, for the parameters were read from a file.
        """
        return self.estimate_posterior()

    def estimate_posterior(self, clock: Clock | None = None) -> Posterior:
        """``posterior``, its time noted on a clock."""
        if not self.stats.energies:
            raise ValueError("this fit came without its curvature, so there is no posterior of it")
        program = _posterior_program(self.options.config().freeze)
        prior = self.options.weights.prior
        return self._once("posterior", clock, program, self.stats.curvature, self.model, prior)

    def landmark_error(self) -> float:
        """Mean distance over the inner 51 of the 68 points, over that of the outer eye corners."""
        found, fitted = self.landmarks, self.fitted_landmarks
        if len(found) == 468:
            found, fitted = (
                np.asarray(landmarks68(jnp.asarray(p, jnp.float32))) for p in (found, fitted)
            )
        distance = np.linalg.norm(found[17:] - fitted[17:], axis=1).mean()
        return float(distance / np.linalg.norm(found[36] - found[45]))

    def render(self, clock: Clock | None = None) -> FitRender:
        """The fit as the working image sees it, drawn once; its time noted on a clock."""
        program = _render_program(self.size)
        principal = self.working.data.principal
        return self._once("render", clock, program, self.parameters, self.models[-1], principal)

    def skin_map(self, clock: Clock | None = None) -> Float[np.ndarray, "s s"]:
        """Pixels of the working image that show skin, 0 to 1: less hair, hands and glasses."""
        data = self.working.data
        if not bool(data.estimate_inliers):
            return np.asarray(data.mask)
        rendered = self.render(clock)
        shown = self._once("skin", clock, _skin_program, rendered, data.image, data.mask)
        if len(self.landmarks) != 468:
            return np.asarray(shown)
        brows = self._once("brows", clock, _brow_program(self.size), data.landmarks)
        return np.maximum(np.asarray(shown), np.asarray(brows * data.mask * rendered.skin))

    def problem(
        self, kind: Literal["energy", "residual"] = "energy"
    ) -> tuple[Energy, FaceParameters, FitData]:
        """The last level's problem at the fit: ``(energy, y0, args)``, ready for any solver.

        ``energy.value(y, args)`` is what a further step of the fit would lower: visible pixels,
        inliers and the landmarks' weights are those at ``y0``, chosen anew by each call. For
        solvers of least squares ``kind="residual"`` has ``energy.residual`` as well, the photo term
        being the square of a root (``photometric_root_residual``).

        Frozen unknowns are None in ``y0`` and stand in ``args.held``; ``put_together`` of
        ``models.parameters`` joins the two. Data of your own are ``args.user``.

        Args:
            kind: ``"energy"`` or ``"residual"``.

        Raises:
            ValueError: another kind.
        """
        if kind not in ("energy", "residual"):
            raise ValueError(f"kind is {kind!r}; 'energy' or 'residual' is needed")
        config = self.options.config()
        weights, terms = weights_as_data(self.options.weights, config.extra_terms)
        program = _observing_program(dataclasses.replace(config, extra_terms=()))
        args = self._once(
            "problem", None, program, self.parameters, self.working.data, self.models[-1], weights
        )
        energy = fit_energy(None, terms, config.freeze, least_squares=kind == "residual")
        return energy, set_apart(self.parameters, config.freeze)[0], args

    def _once(self, name: str, clock: Clock | None, program: Callable[..., Any], *args: Any) -> Any:
        if name not in self._kept:
            self._kept[name] = (clock or Clock()).run(name, program, *args)
        return self._kept[name]


_skin_program = jax.jit(skin_map)


@jax.jit
def _shape_program(model: MorphableModel, y: FaceParameters) -> Float[Array, "n 3"]:
    return model.shape(y.identity, y.expression)


@jax.jit
def _landmark_program(
    model: MorphableModel, points: SurfacePoints, y: FaceParameters, principal: Float[Array, "2"]
) -> Float[Array, "l 2"]:
    posed = y.pose(points(model.shape(y.identity, y.expression)))
    return y.camera(principal).project(posed)[:, :2]


@functools.cache
def _posterior_program(freeze: tuple[str, ...]) -> Any:
    return jax.jit(functools.partial(posterior, freeze=freeze))


@functools.cache
def _observing_program(config: FitConfig) -> Any:
    observing = functools.partial(observe_finest, config=config)
    return jax.jit(observing, compiler_options=quick_compilation())


@functools.cache
def _brow_program(size: int) -> Any:
    return jax.jit(functools.partial(brow_map, size=size))


@functools.cache
def _render_program(size: int) -> Any:
    return jax.jit(lambda y, model, principal: render_fit(y, model, principal, size))
