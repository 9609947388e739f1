"""Gram matrices of a whole database behind any mask, from what is computed once of each texture."""

import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from threadpoolctl import threadpool_limits

from jaxface._machine import usable_cores
from jaxface._types import Bool, Float
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.imaging.resample import block_means
from jaxface.io.atomic import atomic_path
from jaxface.io.digest import digest
from jaxface.io.feature_weights import network_digest
from jaxface.io.file_lock import exclusive
from jaxface.io.gram_cache import GramCache
from jaxface.io.texture_database import LOCK, TextureDatabase
from jaxface.networks.texture_features.network import STYLE_LAYERS, FeatureNetwork
from jaxface.stages.texture.masked_grams import (
    Layout,
    compressed,
    layout,
    masked_grams_of,
    prepare,
    store,
)

FOLDER = "grams"
"""folder of the cache in a database's"""

STAMPS = "textures.json"
"""which file of the cache belongs to which texture file, by size and time of change"""

LARGEST_BYTES = 64 * 1024**3
"""what a cache may hold, unless said otherwise"""


@dataclass(frozen=True)
class PrecomputedGrams:
    """What is cached of a database's textures for one network and resolution."""

    network: FeatureNetwork
    layout: Layout
    files: GramCache
    keys: tuple[str, ...]
    """of the textures' files, in the database's order"""


def bytes_to_precompute(
    database: TextureDatabase,
    network: FeatureNetwork,
    resolution: int | None = None,
    layers: Sequence[str] = STYLE_LAYERS,
) -> int:
    """Bytes that `precompute` will take on disk; arguments and errors are the same."""
    return _files(database, network, resolution, layers, None)[1].bytes_per_texture * len(database)


def precompute(
    database: TextureDatabase,
    network: FeatureNetwork,
    resolution: int | None = None,
    on_progress: Callable[[int, int], None] = lambda done, of: None,
    *,
    layers: Sequence[str] = STYLE_LAYERS,
    folder: str | os.PathLike[str] | None = None,
    maximum_bytes: int = LARGEST_BYTES,
) -> PrecomputedGrams:
    """Compute and keep what `masked_grams` needs; textures that lie there whole are not redone.

    Every file is written whole or not at all, so a killed run goes on where it stopped. Files of
    other networks, resolutions or former textures stay while there is room, the oldest go first.

    Args:
        database: the textures.
        network: extractor of features.
        resolution: texels along a side; a divisor of the database's, by default the same.
        on_progress: told after every texture: how many are done, of how many.
        layers: those whose Gram matrices will be asked for.
        folder: of the cache, by default ``grams`` in the database's folder.
        maximum_bytes: what the cache may come to hold.

    Raises:
        ValueError: the resolution does not divide the database's, or the cache would be too big.
    """
    plan, files, side, identity = _files(database, network, resolution, layers, folder)
    size = files.bytes_per_texture * len(database)
    if size > maximum_bytes:
        raise ValueError(
            f"the cache of {len(database)} textures would hold {size} bytes, more than the "
            f"{maximum_bytes} allowed; a lower resolution needs a quarter for each halving"
        )
    known = _read_stamps(files.path).get(identity, {})
    compute = jax.jit(lambda network, image: store(network, image, plan))
    keys: list[str] = []
    for index, subject in enumerate(database.subjects):
        stamp, (before, key) = database.stamp(subject.name), known.get(subject.name, ("", ""))
        if before != stamp or not files.is_whole(key):
            image = intensity(database.encoded(subject.name), side)
            key = digest(identity, image)
            if not files.is_whole(key):
                files.write(key, compressed(compute(network, jnp.asarray(image)), plan))
            _write_stamp(files.path, identity, subject.name, (stamp, key))
        keys.append(key)
        on_progress(index + 1, len(database))
    files.prune(keys, maximum_bytes)
    return PrecomputedGrams(network, plan, files, tuple(keys))


def find_precomputed(
    database: TextureDatabase,
    network: FeatureNetwork,
    resolution: int | None = None,
    *,
    layers: Sequence[str] = STYLE_LAYERS,
    folder: str | os.PathLike[str] | None = None,
) -> PrecomputedGrams | None:
    """What `precompute` has kept, if it is there for every texture as it is now; else None.

    No texture is read: files count as unchanged while their size and time of change are the same.

    Raises:
        ValueError: the resolution does not divide the database's.
    """
    plan, files, _, identity = _files(database, network, resolution, layers, folder)
    known = _read_stamps(files.path).get(identity, {})
    keys = []
    for subject in database.subjects:
        stamp, key = known.get(subject.name, ("", ""))
        if stamp != database.stamp(subject.name) or not files.is_whole(key, thorough=False):
            return None
        keys.append(key)
    return PrecomputedGrams(network, plan, files, tuple(keys))


def _files(
    database: TextureDatabase,
    network: FeatureNetwork,
    resolution: int | None,
    layers: Sequence[str],
    folder: str | os.PathLike[str] | None,
) -> tuple[Layout, GramCache, int, str]:
    """Layout, files, resolution, and digest of all that the files depend on but the texture."""
    side = database.resolution if resolution is None else resolution
    if side < 1 or database.resolution % side:
        raise ValueError(
            f"resolution is {side}; needed is a divisor of the database's {database.resolution}"
        )
    plan = layout(network, (side, side), layers)
    files = GramCache(folder or database.path / FOLDER, plan.shapes, plan.types)
    return plan, files, side, digest(network_digest(network), repr(plan))


def _read_stamps(folder: Path) -> dict[str, dict[str, tuple[str, str]]]:
    """By `identity` and subject: the texture file's stamp and the cache file's key."""
    try:
        content = json.loads((folder / STAMPS).read_text(encoding="utf-8"))
        return {
            str(identity): {str(name): (str(a), str(b)) for name, (a, b) in entries.items()}
            for identity, entries in content.items()
        }
    except (OSError, ValueError, TypeError, AttributeError):
        return {}  # absent or damaged: found anew from the textures themselves


def _write_stamp(folder: Path, identity: str, subject: str, found: tuple[str, str]) -> None:
    with exclusive(folder / LOCK):
        stamps = _read_stamps(folder)
        stamps.setdefault(identity, {})[subject] = found
        with atomic_path(folder / STAMPS) as temporary:
            temporary.write_text(json.dumps(stamps, indent=1), encoding="utf-8")


def intensity(encoded: Float[np.ndarray, "r r 3"], side: int) -> Float[np.ndarray, "s s"]:
    """Y of YIQ of an sRGB-encoded texture, averaged over blocks of texels."""
    return np.asarray(rgb_to_yiq(jnp.asarray(block_means(encoded, side)))[..., 0], np.float32)


def masked_grams(
    cache: PrecomputedGrams,
    mask: Bool[np.ndarray, "r r"],
    on_progress: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, Float[np.ndarray, "k n n"]]:
    """Gram matrices ``G^l(M(I_k))`` of all textures behind one mask, by layer.

    They are what `stages.blend.blend` takes as its columns. A target to compare with them must be
    of the whole map too, not of a cut of it, whose border the network would see::

        cache = find_precomputed(database, network, side, layers=layers)
        columns = masked_grams(cache, mask)
        target = grams(mask_out(photo_intensity, mask), network, layers=layers)
        blended = blend(columns, target)

    Args:
        cache: by `precompute`.
        mask: true where visible, row 0 at the top, at the cache's resolution.
        on_progress: told after every texture.

    Raises:
        ValueError: the mask is of another shape, or a file has been damaged since.
    """
    prepared = prepare(cache.network, mask, cache.layout)
    channels = cache.network.channels
    found = {
        name: np.empty((len(cache.keys), channels[name], channels[name]), np.float32)
        for name in cache.layout.cells
    }
    threads = max(1, min(usable_cores(), len(cache.keys)))
    free = [prepared, *(prepared.for_another_thread() for _ in range(threads - 1))]

    def one(index: int) -> None:
        own = free.pop()
        try:
            for name, value in masked_grams_of(own, cache.files.read(cache.keys[index])).items():
                found[name][index] = value
        finally:
            free.append(own)

    # BLAS is left one thread: textures go side by side.
    with threadpool_limits(1, "blas"), ThreadPoolExecutor(threads) as pool:
        waiting = [pool.submit(one, index) for index in range(len(cache.keys))]
        try:
            for done, future in enumerate(as_completed(waiting), start=1):
                future.result()
                on_progress(done, len(cache.keys))
        finally:
            pool.shutdown(cancel_futures=True)
    return found
