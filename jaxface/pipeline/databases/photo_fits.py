"""The fits of a folder's photos, kept as small files, and the photos without specularity."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.ndimage import gaussian_filter, maximum_filter

from jaxface._types import Array, Float
from jaxface.imaging.colour import srgb_to_linear
from jaxface.imaging.masks import fill_polygon
from jaxface.imaging.suv import remove_specular_peak
from jaxface.io.digest import digest
from jaxface.io.fit_file import SavedFit, read_fit, write_fit
from jaxface.models.landmark_schemes import LIPS_OUTER
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.fitting._fit import as_photo, fit
from jaxface.pipeline.fitting.fitted_face import FittedFace
from jaxface.stages.fit import FitModel, working_photo
from jaxface.stages.fit.options import FitOptions

LIP_MARGIN = 0.008
"""of the working image's side, by which lips are taken to be wider than their outline"""


class BuildStep(NamedTuple):
    """What `build_database` tells of each photo.

    Attributes:
        stage: ``"fit"`` or ``"texture"``.
        done: photos done in this stage.
        total: photos.
        photo: this one.
        problem: why it is left out, or what is odd about it; None if nothing.
    """

    stage: str
    done: int
    total: int
    photo: Path
    problem: str | None


def fit_photos(
    photos: Sequence[Path],
    names: Sequence[str],
    folder: Path,
    model: MorphableModel,
    options: FitOptions,
    tell: Callable[[BuildStep], None],
) -> tuple[dict[str, SavedFit], str | None]:
    """Fits by subject, made or read again from ``folder``, and the first problem.

    A photo that cannot be read or fitted is told and left out.
    """
    fits: dict[str, SavedFit] = {}
    first_problem = None
    for index, (photo, subject) in enumerate(zip(photos, names, strict=True)):
        problem = None
        file = folder / f"{subject}.npz"
        try:
            origin = {
                "model": model.name,
                "digest": digest(photo.read_bytes()),
                "options": repr(sorted(options.changed().items())),
            }
            if not _is_current(file, origin):
                _write_photo_fit(file, fit(photo, model, options), photo, origin)
            fits[subject] = read_fit(file)
        except (ValueError, OSError) as error:
            problem = f"{photo.name} is left out: {error}"
            first_problem = first_problem or problem
        tell(BuildStep("fit", index + 1, len(photos), photo, problem))
    return fits, first_problem


def _is_current(file: Path, origin: dict[str, str]) -> bool:
    """Whether the fit of this very photo, with this model and options, lies there, whole."""
    try:
        known = read_fit(file).metadata
    except (FileNotFoundError, ValueError):
        return False
    return all(known.get(key) == value for key, value in origin.items())


def _write_photo_fit(file: Path, fitted: FittedFace, photo: Path, origin: dict[str, str]) -> None:
    skin = np.round(255 * np.asarray(fitted.skin_map())).astype(np.uint8)
    write_fit(
        file,
        fitted.parameters,
        {"landmarks": fitted.landmarks.astype(np.float32), "skin": skin},
        {**origin, "photo": photo.name, "landmark_error": fitted.landmark_error()},
    )


class FittedPhoto:
    """A photo with its fit, its specularity removed."""

    def __init__(self, path: Path, saved: SavedFit, diffuse: bool = True):
        """From the photo's file and its fit; ``diffuse``: whether to remove specularity."""
        self.path, self.metadata = path, saved.metadata
        self.parameters = jax.tree.map(jnp.asarray, saved.parameters)
        self.skin = np.asarray(saved.arrays["skin"], np.float32) / 255
        self.landmarks = np.asarray(saved.arrays["landmarks"], np.float64)
        self.diffuse = diffuse

    def fitted(
        self, models: tuple[FitModel, ...], light: Float[Array, "9 3"] | None = None
    ) -> FittedFace:
        """As `fit` gave it, without its history, and the photo without its specularity.

        Args:
            models: levels of detail, the finest last.
            light: of the working image, in place of the fit's own.
        """
        linear = np.asarray(srgb_to_linear(jnp.asarray(as_photo(self.path).pixels)))
        size = len(self.skin)
        working = working_photo(linear, self.landmarks, size=size)
        if self.diffuse:
            mask = self.skin * (1 - _lips(size * working.crop.to_crop(self.landmarks), size))
            linear = _without_specularity(linear, working.crop, mask, self.parameters.light)
            gain = working.gain
            again = working_photo(linear, self.landmarks, size=size)
            data = eqx.tree_at(
                lambda d: d.image, again.data, again.data.image * (gain / again.gain)
            )
            working = again._replace(data=data, gain=gain)
        data = eqx.tree_at(
            lambda d: (d.mask, d.estimate_inliers),
            working.data,
            (jnp.asarray(self.skin), jnp.asarray(False)),
        )
        parameters = self.parameters
        if light is not None:
            parameters = eqx.tree_at(lambda y: y.light, parameters, light)
        return FittedFace(linear, working._replace(data=data), self.landmarks, models, parameters)


def _lips(points: Float[np.ndarray, "l 2"], size: int) -> Float[np.ndarray, "s s"]:
    """Where the lips are, 0 to 1.

    They are redder than any skin beside them: what little they have of the source's colour would
    be taken for gloss, and they for darker than they are.
    """
    outline = points[list(LIPS_OUTER)] if len(points) == 468 else points[48:60]
    inside = np.asarray(fill_polygon(jnp.asarray(outline, jnp.float32), size, size), np.float32)
    grown = maximum_filter(inside, size=2 * round(LIP_MARGIN * size) + 1)
    return gaussian_filter(grown, LIP_MARGIN * size)


def _without_specularity(
    linear: Float[np.ndarray, "h w 3"], crop: Any, skin: Float[np.ndarray, "s s"], light: Array
) -> Float[np.ndarray, "h w 3"]:
    """The photo with the specular peak of the face's skin cut, in the fitted light's colour."""
    height, width = linear.shape[:2]
    low = np.floor(np.maximum(crop.origin, 0)).astype(int)
    high = np.ceil(np.minimum(crop.origin + crop.side, [width, height])).astype(int)
    cut = linear[low[1] : high[1], low[0] : high[0]]
    # Photos of similar size share a program.
    fill = [(0, -n % 64) for n in cut.shape[:2]]
    rows, columns = (np.arange(n + extra[1]) for n, extra in zip(cut.shape[:2], fill, strict=True))
    at = [
        np.clip(((line + 0.5 + low[axis] - crop.origin[axis]) / crop.side * len(skin)).astype(int),
                0, len(skin) - 1)
        for line, axis in ((rows, 1), (columns, 0))
    ]  # fmt: skip
    mask = skin[np.ix_(*at)]
    mask[cut.shape[0] :] = 0
    mask[:, cut.shape[1] :] = 0
    padded = np.pad(cut, (*fill, (0, 0)), mode="edge")
    colour = jnp.maximum(light[0] / jnp.maximum(jnp.max(light[0]), 1e-6), 0.1)
    diffuse = np.asarray(_specular_program(jnp.asarray(padded), colour, jnp.asarray(mask)))
    result = linear.copy()
    result[low[1] : high[1], low[0] : high[0]] = diffuse[: cut.shape[0], : cut.shape[1]]
    return np.maximum(result, 0.0)


_specular_program = jax.jit(remove_specular_peak)
