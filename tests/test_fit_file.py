"""fit.npz: round trip, and what is refused."""

import os

import numpy as np
import pytest

from jaxface.io.fit_file import read_fit, write_fit
from jaxface.models.parameters import FaceParameters


def _parameters() -> FaceParameters:
    rng = np.random.default_rng(0)
    shapes = [(4,), (3,), (2,), (9, 3), (3,), (3,), ()]
    return FaceParameters(*(rng.normal(size=s).astype(np.float32) for s in shapes))


def test_round_trip(tmp_path):
    file = tmp_path / "fit.npz"
    write_fit(file, _parameters(), {"landmarks": np.ones((68, 2))}, {"model": "m", "energies": {}})
    saved = read_fit(file)
    np.testing.assert_array_equal(saved.parameters.light, _parameters().light)
    np.testing.assert_array_equal(saved.arrays["landmarks"], np.ones((68, 2)))
    assert saved.metadata["model"] == "m"
    assert saved.metadata["schema"] == 1
    assert list(tmp_path.iterdir()) == [file]


def test_names_must_not_clash(tmp_path):
    with pytest.raises(ValueError, match="light"):
        write_fit(tmp_path / "fit.npz", _parameters(), {"light": np.ones(3)}, {})


def test_truncated_foreign_and_missing(tmp_path):
    file = tmp_path / "fit.npz"
    write_fit(file, _parameters(), {}, {})
    cut = tmp_path / "cut.npz"
    cut.write_bytes(file.read_bytes()[:200])
    with pytest.raises(ValueError, match="cut.npz"):
        read_fit(cut)
    np.savez(tmp_path / "other.npz", a=np.ones(3))
    with pytest.raises(ValueError, match="lacks"):
        read_fit(tmp_path / "other.npz")
    with pytest.raises(FileNotFoundError):
        read_fit(tmp_path / "none.npz")


def test_pickles_are_refused(tmp_path):
    """In a file that is whole but for the pickle, which would make a folder if it were opened."""

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "made"),)

    write_fit(tmp_path / "fit.npz", _parameters(), {}, {})
    with np.load(tmp_path / "fit.npz") as stored:
        arrays = dict(stored)
    np.savez(tmp_path / "evil.npz", landmarks=np.array([Evil()], dtype=object), **arrays)
    with pytest.raises(ValueError, match="evil.npz"):
        read_fit(tmp_path / "evil.npz")
    assert not (tmp_path / "made").exists()
