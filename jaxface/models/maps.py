"""Maps of one face in one UV layout: arrays by kind, in memory or on disk, walked in windows."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from jaxface._types import Float, Shaped
from jaxface.imaging.resample import means_of_blocks
from jaxface.models.morphable import MorphableModel

Encoding = Literal["linear", "srgb", "none"]
"""of colours; ``none`` where the values are no colours"""

WINDOW = 1024
"""texels along a window's side, unless said otherwise: 12 MB of three float32 channels"""


class UVMap(NamedTuple):
    """One map, row 0 at the top.

    Attributes:
        values: (r, r) or (r, r, c); any array that can be sliced, a memory map too.
        unit: of the values: ``1``, ``mm``, ``index``, ...
        encoding: of colours.
        weight: (r, r) how far each texel is to be trusted, 0 to 1; None: everywhere.
    """

    values: Shaped[np.ndarray, "r r *c"]
    unit: str = "1"
    encoding: Encoding = "none"
    weight: Shaped[np.ndarray, "r r"] | None = None


@dataclass(frozen=True, eq=False)
class UVMaps(Mapping[str, UVMap]):
    """Maps by kind, all of one resolution in the UVs of one model.

    Nothing is copied or read until it is asked for, so that a map may lie on disk
    (``numpy.load(path, mmap_mode="r")``, ``numpy.memmap``) and be larger than the memory.

    Raises:
        ValueError: a map is not square, differs from the others in size, or its weight does.
    """

    digest: str
    """of the UV layout (`uv_digest`)"""
    kinds: Mapping[str, UVMap]

    def __post_init__(self) -> None:
        for kind, found in self.kinds.items():
            side = self.resolution
            if found.values.shape[:2] != (side, side) or found.values.ndim not in (2, 3):
                raise ValueError(
                    f"map {kind!r} has shape {found.values.shape}; ({side}, {side}) or "
                    f"({side}, {side}, channels) is needed"
                )
            if found.weight is not None and found.weight.shape != (side, side):
                raise ValueError(
                    f"the weight of map {kind!r} has shape {found.weight.shape}; "
                    f"({side}, {side}) is needed"
                )

    @property
    def resolution(self) -> int:
        """Texels along a side; 0 without maps."""
        return next((len(found.values) for found in self.kinds.values()), 0)

    def __getitem__(self, kind: str) -> UVMap:
        """A map by its kind.

        Raises:
            KeyError: there is none of this kind.
        """
        if kind not in self.kinds:
            raise KeyError(f"there is no map of kind {kind!r}; there are {sorted(self.kinds)}")
        return self.kinds[kind]

    def __iter__(self) -> Iterator[str]:
        return iter(self.kinds)

    def __len__(self) -> int:
        return len(self.kinds)

    def with_maps(self, **kinds: UVMap) -> "UVMaps":
        """These and others, which replace those of their kind."""
        return replace(self, kinds={**self.kinds, **kinds})

    def windows(self, side: int = WINDOW) -> Iterator[tuple[slice, slice]]:
        """Rows and columns of squares that cover the maps, row by row; the last may be smaller.

        Raises:
            ValueError: the side is not positive.
        """
        if side < 1:
            raise ValueError(f"windows of {side} texels; 1 or more are needed")
        steps = [slice(i, min(i + side, self.resolution)) for i in range(0, self.resolution, side)]
        return ((rows, columns) for rows in steps for columns in steps)

    def reduced(self, kind: str, side: int) -> tuple[Float[np.ndarray, "s s c"], np.ndarray]:
        """Means of a map over blocks of texels, by its weight, and the blocks' mean weight.

        A window of the map is in memory at a time, no more. Where the weight is below 0.001 the
        mean fades to 0.

        Args:
            kind: of the map.
            side: blocks along a side, a divisor of the resolution; at least the resolution: the map
                as it is.

        Returns:
            (s, s, c) float32, and (s, s).

        Raises:
            ValueError: the side does not divide the resolution.
        """
        found = self[kind]
        size = self.resolution
        side = min(side, size)
        if side < 1 or size % side:
            raise ValueError(f"{size} texels cannot be reduced to {side}; a divisor is needed")
        factor = size // side
        channels = found.values.shape[2] if found.values.ndim == 3 else 1
        means = np.empty((side, side, channels), np.float32)
        share = np.empty((side, side), np.float32)
        for rows, columns in self.windows(max(WINDOW // factor, 1) * factor):
            at = tuple(slice(s.start // factor, s.stop // factor) for s in (rows, columns))
            values = np.asarray(found.values[rows, columns], np.float32)
            values = values.reshape(*values.shape[:2], channels)
            if found.weight is None:
                means[at], share[at] = means_of_blocks(values, factor), 1.0
                continue
            weight = np.asarray(found.weight[rows, columns], np.float32)[..., None]
            mean = means_of_blocks(weight, factor)
            means[at] = means_of_blocks(values * weight, factor) / np.maximum(mean, 1e-3)
            share[at] = mean[..., 0]
        return means, share


def uv_digest(model: MorphableModel) -> str:
    """Digest of a model's texture coordinates and their triangles, the same on any machine."""
    uv = np.round(np.asarray(model.uv, np.float64) * 2**20).astype("<i8")
    faces = np.asarray(model.uv_faces).astype("<i8")
    return hashlib.blake2b(uv.tobytes() + faces.tobytes(), digest_size=16).hexdigest()
