"""Make tests/data/flame_chumpy.pkl: a tiny rig pickled with chumpy's own classes.

    pip install 'numpy<1.24' 'scipy<1.16' chumpy && python tools/make_flame_fixture.py tests/data

FLAME's official files hold chumpy expressions and a sparse joint regressor, pickled at protocol
2 or below. The rig is a made-up one, which tests/test_model_loaders.py takes from `rig` to
compare with; it carries nobody's data.
"""

import inspect
import pickle
import sys
from pathlib import Path

import numpy as np


def rig() -> dict:
    """A head-sized grid (metres) with five joints, of which the jaw holds the lower half."""
    y, x = np.mgrid[0:4, 0:4].reshape(2, -1)
    template = np.stack([0.04 * x, 0.05 * y, 0.02 * np.sin(x + y)], axis=1)
    count = len(template)
    corner = np.array([i * 4 + j for i in range(3) for j in range(3)])
    faces = np.concatenate(
        [
            np.stack([corner, corner + 1, corner + 5], 1),
            np.stack([corner, corner + 5, corner + 4], 1),
        ]
    )
    index = np.arange(count * 3)
    shapedirs = 0.002 * np.cos(np.outer(index, np.arange(1, 106)) * 0.11)
    posedirs = 0.001 * np.sin(np.outer(index, np.arange(1, 37)) * 0.07)
    jaw = (y < 2).astype(float)
    weights = np.zeros((count, 5))
    weights[:, 2], weights[:, 1] = 0.9 * jaw, 1 - 0.9 * jaw
    regressor = np.zeros((5, count))
    regressor[np.arange(5), [5, 6, 9, 10, 11]] = 0.5
    regressor[:, 4] += 0.5
    return {
        "v_template": template,
        "f": faces.astype(np.uint32),
        "shapedirs": shapedirs.reshape(count, 3, 105),
        "posedirs": posedirs.reshape(count, 3, 36),
        "weights": weights,
        "J_regressor": regressor,
        "kintree_table": np.array([[2**32 - 1, 0, 1, 1, 1], [0, 1, 2, 3, 4]], np.int64),
        "bs_type": "lrotmin",
    }


def main() -> None:
    # chumpy predates Python 3.11, which dropped this name.
    setattr(inspect, "getargspec", inspect.getfullargspec)  # noqa: B010
    import chumpy
    import scipy.sparse

    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "tests/data")
    folder.mkdir(parents=True, exist_ok=True)
    content = rig()
    wider = np.concatenate([content["v_template"], np.ones((16, 2))], axis=1)
    content["v_template"] = chumpy.Ch(wider)[:, :3]  # a Select of a leaf
    content["shapedirs"] = chumpy.Ch(content["shapedirs"].astype(np.float32))
    posedirs = chumpy.Ch(content["posedirs"].reshape(48, 36))
    content["posedirs"] = chumpy.reshape(posedirs, (16, 3, 36))
    half = content["weights"][:8], content["weights"][8:]
    content["weights"] = chumpy.concatenate([chumpy.Ch(part) for part in half], axis=0)
    content["J_regressor"] = scipy.sparse.csc_matrix(content["J_regressor"])
    with open(folder / "flame_chumpy.pkl", "wb") as file:
        pickle.dump(content, file, protocol=2)


if __name__ == "__main__":
    main()
