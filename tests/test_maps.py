"""Sets of UV maps: in memory or on disk, walked in windows."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxface.models.maps import UVMap, UVMaps


def some_maps(side: int, seed: int = 0) -> UVMaps:
    rng = np.random.default_rng(seed)
    return UVMaps(
        "layout",
        {
            "albedo": UVMap(
                rng.random((side, side, 3), np.float32), encoding="linear",
                weight=rng.random((side, side), np.float32),
            ),
            "height": UVMap(rng.random((side, side), np.float32), unit="mm"),
        },
    )  # fmt: skip


@given(st.integers(1, 70), st.integers(1, 80))
def test_windows_cover_every_texel_once(side, window):
    maps = UVMaps("layout", {"free": UVMap(np.zeros((side, side), bool))})
    times = np.zeros((side, side), int)
    for rows, columns in maps.windows(window):
        assert rows.stop - rows.start <= window and columns.stop - columns.start <= window
        times[rows, columns] += 1
    assert (times == 1).all()


def test_means_are_weighted(monkeypatch):
    maps = some_maps(48)
    values, weight = maps["albedo"].values, maps["albedo"].weight
    found, share = maps.reduced("albedo", 12)
    for row, column in ((0, 0), (5, 11)):
        at = np.s_[4 * row : 4 * row + 4, 4 * column : 4 * column + 4]
        expected = np.sum(values[at] * weight[at][..., None], axis=(0, 1)) / weight[at].sum()
        np.testing.assert_allclose(found[row, column], expected, rtol=1e-5)
        np.testing.assert_allclose(share[row, column], weight[at].mean(), rtol=1e-5)
    plain, ones = maps.reduced("height", 12)
    assert plain.shape == (12, 12, 1) and (ones == 1).all()
    # In windows that do not divide the map, and as it is.
    monkeypatch.setattr("jaxface.models.maps.WINDOW", 20)
    np.testing.assert_array_equal(maps.reduced("albedo", 12)[0], found)
    np.testing.assert_array_equal(maps.reduced("height", 48)[0][..., 0], maps["height"].values)


def test_nothing_is_seen_where_the_weight_is_zero():
    nothing = UVMap(np.full((8, 8, 3), 7.0, np.float32), weight=np.zeros((8, 8), np.float32))
    means, share = UVMaps("layout", {"photo": nothing}).reduced("photo", 4)
    assert (means == 0).all() and (share == 0).all()


def test_a_map_on_disk_is_read_window_by_window(tmp_path, monkeypatch):
    monkeypatch.setattr("jaxface.models.maps.WINDOW", 64)
    side = 256
    stored = np.lib.format.open_memmap(
        tmp_path / "height.npy", mode="w+", dtype=np.float32, shape=(side, side)
    )
    stored[:] = np.arange(side * side, dtype=np.float32).reshape(side, side)
    stored.flush()
    reads = []

    class Watched(np.memmap):
        def __getitem__(self, index):
            found = super().__getitem__(index)
            reads.append(np.size(found))
            return found

    opened = np.load(tmp_path / "height.npy", mmap_mode="r").view(Watched)
    maps = some_maps(side).with_maps(height=UVMap(opened, unit="mm"))
    assert isinstance(maps["height"].values, np.memmap)
    found = maps.reduced("height", 32)[0][..., 0]
    assert max(reads) == 64 * 64 and len(reads) == 16
    np.testing.assert_allclose(found, stored.reshape(32, 8, 32, 8).mean(axis=(1, 3)), rtol=1e-5)


def test_maps_that_do_not_fit_are_named():
    maps = some_maps(16)
    assert list(maps) == ["albedo", "height"] and len(maps) == 2 and maps.resolution == 16
    with pytest.raises(KeyError, match="no map of kind 'normal'"):
        maps["normal"]
    with pytest.raises(ValueError, match=r"'normal' has shape \(8, 8, 3\); \(16, 16\)"):
        maps.with_maps(normal=UVMap(np.zeros((8, 8, 3))))
    with pytest.raises(ValueError, match="weight of map 'normal'"):
        maps.with_maps(normal=UVMap(np.zeros((16, 16, 3)), weight=np.zeros((16, 15))))
    with pytest.raises(ValueError, match="cannot be reduced to 5"):
        maps.reduced("height", 5)
    with pytest.raises(ValueError, match="windows of 0"):
        maps.windows(0)
