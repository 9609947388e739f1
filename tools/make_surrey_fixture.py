"""Make tests/data/eos_*.bin: tiny models in eos's binary format, written by eos itself.

    pip install eos-py && python tools/make_surrey_fixture.py tests/data

The geometry is a made-up bumpy sheet, so the files carry nobody's data; the tests take `sheet`
and `modes` from here to compare with.
"""

import sys
from pathlib import Path

import numpy as np


def sheet(side: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (side^2, 3) of a sheet that bulges towards +z, and its triangles."""
    y, x = np.mgrid[0:side, 0:side].reshape(2, -1)
    z = 10.0 * np.sin(x + 1.0) * np.sin(y + 1.0)
    vertices = np.stack([20.0 * x, 20.0 * y, z], axis=1).astype(np.float32)
    corner = np.array([i * side + j for i in range(side - 1) for j in range(side - 1)])
    a, b, c, d = corner, corner + 1, corner + side + 1, corner + side
    return vertices, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])


def modes(rows: int, count: int, phase: float) -> np.ndarray:
    """An orthonormal (rows, count) float32 basis."""
    waves = np.cos(np.outer(np.arange(rows) + 0.5, np.arange(1, count + 1)) * 0.37 + phase)
    return np.linalg.qr(waves)[0].astype(np.float32)


def main() -> None:
    import eos

    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "tests/data")
    folder.mkdir(parents=True, exist_ok=True)
    model = eos.morphablemodel
    vertices, triangles = sheet()
    size = vertices.size
    triangles = triangles.tolist()
    shape = model.PcaModel(
        vertices.ravel(), modes(size, 3, 0.1), np.array([400, 100, 25], np.float32), triangles
    )
    colour = model.PcaModel(
        np.tile(np.array([0.7, 0.5, 0.02], np.float32), size // 3),
        modes(size, 2, 0.7),
        np.array([0.04, 0.01], np.float32),
        triangles,
    )
    offset = np.full(size, 0.5, np.float32)
    expression = model.PcaModel(
        offset, modes(size, 2, 1.3), np.array([9, 4], np.float32), triangles
    )
    blendshapes = [
        model.Blendshape("surprise", np.arange(size, dtype=np.float32)),
        model.Blendshape("joy", -np.ones(size, np.float32)),
    ]
    uv = [[float(x) / 60.0, 0.25 * float(y) / 60.0] for x, y, _ in vertices]
    landmarks = {str(number): (number * 5) % len(vertices) for number in range(1, 69)}
    full = model.MorphableModel(shape, expression, colour, landmarks, uv, triangles)
    model.save_model(full, str(folder / "eos_full.bin"))
    mixed = model.MorphableModel(shape, blendshapes, colour, None, uv)
    model.save_model(mixed, str(folder / "eos_blendshapes.bin"))
    bare = model.MorphableModel(shape, model.PcaModel())
    model.save_model(bare, str(folder / "eos_shape_only.bin"))
    model.save_blendshapes(blendshapes, str(folder / "eos_expressions.bin"))


if __name__ == "__main__":
    main()
