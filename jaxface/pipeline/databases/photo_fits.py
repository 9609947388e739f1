"""The fits of a folder's photos, kept as small files, and the photos without specularity."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.imaging.colour import srgb_to_linear
from jaxface.io.digest import digest
from jaxface.io.fit_file import SavedFit, read_fit, write_fit
from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.fitting._fit import fit
from jaxface.pipeline.fitting.fitted_face import FittedFace
from jaxface.pipeline.photo import as_photo
from jaxface.stages.fit import FitModel, working_photo
from jaxface.stages.fit.options import FitOptions
from jaxface.stages.texture.specularity import lips, without_specularity


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
            mask = self.skin * (1 - lips(size * working.crop.to_crop(self.landmarks), size))
            linear = without_specularity(linear, working.crop, mask, self.parameters.light)
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
