"""Train a feature network on pictures that are at hand, and write its weights with a report."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.io.atomic import atomic_path
from jaxface.io.cache_folder import cache_dir
from jaxface.io.checkpoint import Checkpoint
from jaxface.io.digest import digest
from jaxface.io.feature_weights import save_network
from jaxface.io.formats.image import read_image
from jaxface.io.pictures.chart import convergence_svg
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.pipeline.databases.painted import synth_database
from jaxface.run.kept_programs import source_digest
from jaxface.training.features import (
    CROP,
    TrainingState,
    check_pictures,
    equalised,
    identification,
    start_training,
    train,
)

OnStep = Callable[[str, int, int], None]

STEPS = 300
SKINS, SKIN_RESOLUTION, SKIN_SEED = 8, 512, 7
"""procedural skins beside the pictures; of another population than the default database's"""

BUNDLED_PICTURES = (
    "astronaut", "camera", "cat", "coffee", "hubble_deep_field", "moon", "retina", "rocket",
    "stereo_motorcycle",
)  # fmt: skip
"""functions of ``skimage.data`` whose pictures come with scikit-image, CC0 or public domain"""

LICENCE = "CC0-1.0: trained by jaxface on CC0 and public-domain pictures and procedural skins"
OWN_LICENCE = "trained by jaxface on the user's own pictures"

CHECKPOINT_EVERY = 50
_STATE = "state"
_STYLE = "text{font:12px sans-serif;fill:#555}.grid{stroke:#ddd}.series-0{stroke:#2a6f97;fill:none}"


def train_features(
    images: str | os.PathLike[str] | None,
    out: str | os.PathLike[str],
    steps: int = STEPS,
    seed: int = 0,
    on_step: OnStep = lambda what, done, of: None,
    *,
    skins: int = SKINS,
    batch: int = 16,
    shape: str | tuple[tuple[int, int], ...] = "compact",
) -> FeatureNetwork:
    """Train, equalise the layers, and write the network where ``load_network`` reads it.

    Beside ``out`` come ``.json`` (loss at each step; how often a texture's other half is found
    among 64, before and after) and ``.svg`` (the loss). While it runs there is a folder
    ``.part``, from which a call with the same pictures, settings and code goes on.

    Args:
        images: folder of pictures, each at least 256 px high and 128 px wide; by default those
            that come with scikit-image.
        out: the ``.npz`` to write; kernels are float16.
        steps: of the optimiser.
        seed: of the initial weights and the crops.
        on_step: called with (what, done, of).
        skins: how many procedural skins to add.
        batch: pairs of crops in a step.
        shape: of the network, see `random_network`.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: ``out`` is no ``.npz``, a file is no image, pictures are too few or too small.
    """
    out = Path(out)
    if out.suffix != ".npz":
        raise ValueError(f"out is {str(out)!r}; needed is a file name that ends in .npz")
    state = start_training(shape, seed, steps)
    pictures = [*(scikit_pictures() if images is None else folder_pictures(images))]
    pictures += skin_pictures(skins, on_step)
    pictures = [level for picture in pictures for level in _octaves(picture)]
    check_pictures(pictures)
    initial = identification(state.learner.network, pictures)
    settings = repr((steps, seed, batch, shape))
    key = digest(source_digest(), settings, repr([*_arrays(state)]), *pictures)
    checkpoint = Checkpoint(out.with_suffix(".part"), key)
    state = start = _resumed(checkpoint, state)
    for state in train(pictures, steps, seed, batch, shape, start):
        on_step("steps", state.step, steps)
        if state.step % CHECKPOINT_EVERY == 0:
            _keep(checkpoint, state)
    found = equalised(state.learner.network)
    network = FeatureNetwork(
        found.kernels, found.biases, found.pooling, "trained",
        LICENCE if images is None else OWN_LICENCE,
    )  # fmt: skip
    save_network(out, network, half=True)
    _report(out, state, seed, len(pictures), initial, identification(network, pictures))
    checkpoint.clear()
    return network


def scikit_pictures() -> list[Float[np.ndarray, "h w"]]:
    """Y of the pictures that come with scikit-image, see `BUNDLED_PICTURES`."""
    from skimage import data

    pictures = []
    for name in BUNDLED_PICTURES:
        found = getattr(data, name)()
        found = found[0] if isinstance(found, tuple) else found
        pictures.append(_intensity(np.asarray(found, np.float32) / 255))
    return pictures


def folder_pictures(folder: str | os.PathLike[str]) -> list[Float[np.ndarray, "h w"]]:
    """Y of all files of a folder, in the order of their names; hidden ones do not count.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: it holds no files, or one is no image.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"there is no folder {folder}")
    files = sorted(p for p in folder.iterdir() if p.is_file() and not p.name.startswith("."))
    if not files:
        raise ValueError(f"{folder} holds no pictures")
    return [_intensity(read_image(file).pixels) for file in files]


def skin_pictures(
    count: int, on_step: OnStep = lambda what, done, of: None
) -> list[Float[np.ndarray, "h w"]]:
    """Y of procedural skins, kept in the cache for the next time."""
    if count < 1:
        return []
    database = synth_database(
        cache_dir() / "training-skins", count, SKIN_RESOLUTION, SKIN_SEED,
        lambda done, of: on_step("procedural skins", done, of),
    )  # fmt: skip
    return [_intensity(database.encoded(name)) for name in database.names[:count]]


def _intensity(encoded: Float[np.ndarray, "h w *c"]) -> Float[np.ndarray, "h w"]:
    if encoded.ndim == 2:
        return encoded
    return np.asarray(rgb_to_yiq(jnp.asarray(encoded[..., :3], jnp.float32))[..., 0])


def _octaves(picture: Float[np.ndarray, "h w"]) -> list[Float[np.ndarray, "h w"]]:
    """The picture at full, half, quarter .. size, as long as it can be cropped."""
    levels = [picture]
    while levels[-1].shape[0] >= 8 * CROP and levels[-1].shape[1] >= 4 * CROP:
        h, w = (side // 2 * 2 for side in levels[-1].shape)
        x = levels[-1][:h, :w]
        levels.append((x[::2, ::2] + x[1::2, ::2] + x[::2, 1::2] + x[1::2, 1::2]) / 4)
    return levels


def _arrays(state: TrainingState) -> dict[str, Array]:
    """Weights, temperatures and the optimiser's memory, each by its place in the state."""
    leaves, _ = jax.tree_util.tree_flatten_with_path((state.learner, state.optimiser))
    return {jax.tree_util.keystr(place): leaf for place, leaf in leaves}


def _keep(checkpoint: Checkpoint, state: TrainingState) -> None:
    arrays = {name: np.asarray(x) for name, x in _arrays(state).items()}
    checkpoint.write(_STATE, arrays, {"step": state.step, "losses": state.losses})


def _resumed(checkpoint: Checkpoint, start: TrainingState) -> TrainingState:
    """The state kept last, or the start."""
    kept = checkpoint.read(_STATE)
    if kept is None:
        return start
    structure = jax.tree.structure((start.learner, start.optimiser))
    leaves = [jnp.asarray(kept.arrays[name], x.dtype) for name, x in _arrays(start).items()]
    learner, memory = jax.tree.unflatten(structure, leaves)
    return TrainingState(kept.record["step"], learner, memory, tuple(kept.record["losses"]))


def _report(
    out: Path, state: TrainingState, seed: int, pictures: int, before: float, after: float
) -> None:
    report = {
        "task": "find the neighbour of each crop by its Gramians",
        "pictures": pictures,
        "steps": state.step,
        "seed": seed,
        "identified_before": before,
        "identified": after,
        "losses": state.losses,
    }
    with atomic_path(out.with_suffix(".json")) as temporary:
        temporary.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    title = f"neighbours found among 64: {before:.0%} before, {after:.0%} after"
    chart = convergence_svg([{"name": title, "terms": {"loss": state.losses}}])
    chart = f'<svg xmlns="http://www.w3.org/2000/svg"><style>{_STYLE}</style>{chart}</svg>'
    with atomic_path(out.with_suffix(".svg")) as temporary:
        temporary.write_text(chart, encoding="utf-8")
