"""The bundled model: a plausible, well-formed, labelled statistical head."""

from importlib import resources

import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.geometry.mesh import boundary_edges
from jaxface.io.face_models.model_file import load_bundled, read_metadata
from jaxface.models.landmark_schemes import CONTOURS, landmarks68
from jaxface.models.morphable import MorphableModel
from jaxface.models.subdivide import subdivide

ARKIT = set(
    """browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff
    cheekSquintLeft cheekSquintRight eyeBlinkLeft eyeBlinkRight eyeLookDownLeft eyeLookDownRight
    eyeLookInLeft eyeLookInRight eyeLookOutLeft eyeLookOutRight eyeLookUpLeft eyeLookUpRight
    eyeSquintLeft eyeSquintRight eyeWideLeft eyeWideRight jawForward jawLeft jawOpen jawRight
    mouthClose mouthDimpleLeft mouthDimpleRight mouthFrownLeft mouthFrownRight mouthFunnel
    mouthLeft mouthLowerDownLeft mouthLowerDownRight mouthPressLeft mouthPressRight mouthPucker
    mouthRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper mouthSmileLeft
    mouthSmileRight mouthStretchLeft mouthStretchRight mouthUpperUpLeft mouthUpperUpRight
    noseSneerLeft noseSneerRight tongueOut""".split()
)
FACE = ("forehead", "temples", "nose", "cheeks", "chin", "lips", "eyelids")


@pytest.fixture(scope="module")
def model() -> MorphableModel:
    return load_bundled("makehuman")


def full_expression(model: MorphableModel, *names: str) -> np.ndarray:
    """The mean with the named shapes at activation 1."""
    z = np.zeros(model.expression.count)
    for name in names:
        index = model.expression_names.index(name)
        z[index] = 1 / float(model.expression.std[index])
    return np.asarray(model.shape(jnp.zeros(model.identity.count), jnp.asarray(z)))


def signed_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = (uv[faces[:, i]] for i in range(3))
    u, v = b - a, c - a
    return 0.5 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])


def test_size_and_metadata(model):
    path = resources.files("jaxface") / "assets" / "makehuman.npz"
    assert len(path.read_bytes()) < 4e6
    assert 3000 < model.vertex_count < 5000
    assert model.identity.count >= 80 and model.albedo.count >= 8
    assert set(model.expression_names) == ARKIT and model.expression.count == 52
    assert set(FACE) < set(model.region_names)
    assert "CC0" in model.licence
    with resources.as_file(path) as file:
        source = read_metadata(file)["source"]
    assert {"seed", "identity", "expression", "albedo", "landmarks", "data"} <= set(source)


def test_modes_are_ordered_principal_components(model):
    for basis in (model.identity, model.albedo):
        columns = np.asarray(basis.basis, np.float64).reshape(-1, basis.count)
        np.testing.assert_allclose(np.linalg.norm(columns, axis=0), basis.std, rtol=2e-2)
        assert np.all(np.sort(np.asarray(basis.std))[::-1] == np.asarray(basis.std))
        # Orthogonal up to the quantisation of the smallest modes.
        unit = columns / np.linalg.norm(columns, axis=0)
        assert np.abs(unit.T @ unit - np.eye(basis.count)).max() < 0.03


def test_adult_measures(model):
    mean = np.asarray(model.mean)
    eyes = mean[np.asarray(model.region_mask("eyes"))]
    left, right = eyes[eyes[:, 0] > 0], eyes[eyes[:, 0] < 0]
    pupils = left[left[:, 2].argmax()], right[right[:, 2].argmax()]
    assert pupils[0][0] - pupils[1][0] == pytest.approx(62.5, abs=2.5)
    head = mean[np.asarray(model.region_mask(*FACE, "scalp"))]
    assert 135 < np.ptp(head[:, 0]) < 165  # breadth
    assert 185 < np.ptp(head[:, 2]) < 230  # depth, nose to back
    spread = np.sqrt((np.asarray(model.identity.basis) ** 2).sum((1, 2)))
    face = np.asarray(model.region_mask(*FACE))
    assert 2.5 < np.sqrt((spread[face] ** 2).mean()) < 4.5


def test_the_mean_is_symmetric(model):
    mean = np.asarray(model.mean)
    skin = mean[np.asarray(model.region_mask(*FACE))]
    flipped = skin * [-1, 1, 1]
    gap = np.array([np.linalg.norm(mean - p, axis=1).min() for p in flipped[::7]])
    assert gap.max() < 0.02


def test_surface_is_manifold_and_faces_outward(model):
    faces, mean = np.asarray(model.faces), np.asarray(model.mean)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert len(np.unique(edges, axis=0)) == len(edges)  # consistent winding, no edge thrice
    a, b, c = (mean[faces[:, i]] for i in range(3))
    normal = np.cross(b - a, c - a)
    for part, share in ((("eyes",), 1.0), (("scalp",), 0.98), (("forehead", "cheeks"), 0.98)):
        inside = np.asarray(model.region_mask(*part))
        chosen = inside[faces].all(1)
        eye_side = np.sign(a[:, :1])
        centre = {
            "eyes": np.concatenate(
                [
                    np.where(
                        eye_side > 0,
                        mean[inside & (mean[:, 0] > 0)].mean(0)[0],
                        mean[inside & (mean[:, 0] < 0)].mean(0)[0],
                    ),
                    np.full_like(eye_side, mean[inside].mean(0)[1]),
                    np.full_like(eye_side, mean[inside].min(0)[2] - 1),
                ],
                axis=1,
            )
        }.get(part[0], np.array([0.0, 0.0, 0.0]))
        outward = (normal * (a - centre)).sum(1)[chosen] > 0
        assert outward.mean() >= share, part
    # Open only behind the lids and inside the mouth: nothing that shows from outside.
    hidden = np.asarray(model.region_mask("eyes", "eyelids", "mouth_interior"))
    assert hidden[boundary_edges(faces)].all()


def test_triangles_and_quads_agree(model):
    quads, uv_quads = np.asarray(model.quads), np.asarray(model.uv_quads)
    assert ((quads < 0) == (uv_quads < 0)).all()
    corners = np.concatenate([quads[:, :3], quads[:, [0, 2, 3]][quads[:, 3] >= 0]])
    assert {tuple(t) for t in corners.tolist()} == {
        tuple(t) for t in np.asarray(model.faces).tolist()
    }
    # Every uv corner belongs to one vertex.
    owner = {}
    for vertex, corner in zip(quads.ravel().tolist(), uv_quads.ravel().tolist(), strict=True):
        if vertex >= 0:
            assert owner.setdefault(corner, vertex) == vertex


def test_uv_islands_do_not_overlap(model):
    uv, faces = np.asarray(model.uv, np.float64), np.asarray(model.uv_faces)
    assert uv.min() > 0 and uv.max() < 1
    area = signed_areas(uv, faces)
    assert (area > 0).mean() > 0.995  # the source layout folds a few quads of ear and nostril
    covered = np.zeros((600, 600), int)
    centres = (np.arange(600) + 0.5) / 600
    for triangle in uv[faces]:
        low, high = triangle.min(0), triangle.max(0)
        i, j = (np.flatnonzero((centres > lo) & (centres < hi))
                for lo, hi in zip(low, high, strict=True))  # fmt: skip
        if len(i) == 0 or len(j) == 0:
            continue
        x, y = np.meshgrid(centres[i], centres[j], indexing="ij")
        inside = np.ones(x.shape, bool)
        for k in range(3):
            (ax, ay), (bx, by) = triangle[k], triangle[(k + 1) % 3]
            inside &= (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
        covered[np.ix_(i, j)] += inside
    assert (covered > 1).mean() < 2e-4
    assert (covered > 0).mean() > 0.6
    face = np.asarray(model.region_mask(*FACE))[np.asarray(model.faces)].all(1)
    assert area[face].sum() > 0.2


def test_every_region_is_populated_and_symmetric(model):
    mean, region = np.asarray(model.mean), np.asarray(model.region)
    for index, name in enumerate(model.region_names):
        members = mean[region == index]
        assert len(members) >= 20, name
        left, right = (members[:, 0] > 0.5).sum(), (members[:, 0] < -0.5).sum()
        assert abs(left - right) <= 0.06 * len(members) + 2, name
    height = {n: mean[np.asarray(model.region_mask(n)), 1].mean() for n in FACE}
    assert height["forehead"] > height["eyelids"] > height["nose"] > height["lips"] > height["chin"]


def test_landmarks_sit_where_their_names_say(model):
    points = np.asarray(model.landmarks468(model.mean))
    points68 = np.asarray(model.landmarks68(model.mean))
    np.testing.assert_allclose(points68[17:], np.asarray(landmarks68(jnp.asarray(points)))[17:],
                               atol=1.5)  # fmt: skip
    region, names = np.asarray(model.region), model.region_names
    # Nearest vertex of each point: never an eyeball or the mouth's inside.
    nearest = np.array(
        [np.linalg.norm(np.asarray(model.mean) - p, axis=1).argmin() for p in points]
    )
    allowed = {names.index(n) for n in (*FACE, "scalp", "ears", "neck")}
    on_skin = np.isin(region[np.asarray(model.landmarks468.vertices)], list(allowed)).all(1)
    assert on_skin.mean() > 0.99
    assert names[region[nearest[4]]] == "nose" and names[region[nearest[152]]] == "chin"
    inner = [names[region[v]] for v in nearest[list(CONTOURS["inner lips"])]]
    assert set(inner) == {"lips"}
    outer = [names[region[v]] for v in nearest[list(CONTOURS["outer lips"])]]
    assert set(outer) <= {"lips", "cheeks", "chin"} and outer.count("lips") >= 8
    lids = [names[region[v]] for v in nearest[list(CONTOURS["right eye"])]]
    assert set(lids) <= {"eyelids", "eyes"}
    # The subject's right jaw comes first, and right is at negative x.
    assert points68[0, 0] < -50 < 50 < points68[16, 0]
    assert points68[36, 0] < points68[39, 0] < points68[42, 0] < points68[45, 0]
    assert points68[8, 1] < points68[57, 1] < points68[30, 1] < points68[27, 1]
    for name, corners in (("eyes", (36, 45)), ("mouth", (48, 54)), ("jaw", (2, 14))):
        a, b = points68[corners[0]], points68[corners[1]]
        np.testing.assert_allclose(a * [-1, 1, 1], b, atol=0.8, err_msg=name)
    assert points[4, 2] == pytest.approx(points[:, 2].max(), abs=2.0)  # the tip of the nose


def test_landmark_weights_are_barycentric(model):
    for points, count in ((model.landmarks68, 68), (model.landmarks468, 468)):
        weights = np.asarray(points.weights)
        assert weights.shape == (count, 3) and weights.min() >= 0
        np.testing.assert_allclose(weights.sum(1), 1, atol=1e-5)


def test_eyeballs_lie_behind_the_lids(model):
    rng = np.random.default_rng(0)
    eyes = np.asarray(model.region_mask("eyes"))
    lid_points = list(CONTOURS["right eye"])
    for _ in range(5):
        identity = jnp.asarray(rng.normal(size=model.identity.count))
        shape = model.shape(identity, jnp.zeros(52))
        ball = np.asarray(shape)[eyes]
        ball = ball[ball[:, 0] < 0]
        lids = np.asarray(model.landmarks468(shape))[lid_points]
        # The lids' rim rings the ball's front at about its distance, before its rear rim.
        assert lids[:, 2].min() > ball[:, 2].min()
        assert abs(lids[:, :2].mean(0) - ball[ball[:, 2].argmax(), :2]).max() < 5
        assert np.linalg.norm(ball[:, None] - lids, axis=2).min(0).max() < 6


def test_expressions_move_what_they_name(model):
    rest = np.asarray(model.mean)
    marks = np.asarray(model.landmarks468(model.mean))

    def moved(*names):
        return np.asarray(model.landmarks468(jnp.asarray(full_expression(model, *names)))) - marks

    opened = moved("jawOpen")
    assert -60 < opened[14, 1] < -20 and abs(opened[13, 1]) < 4  # lower and upper inner lip
    assert np.abs(opened[[33, 133, 263, 362]]).max() < 0.5
    blink = moved("eyeBlinkLeft")
    gap = marks[386, 1] - marks[374, 1]
    assert blink[386, 1] - blink[374, 1] == pytest.approx(-gap, rel=0.5)
    assert np.abs(blink[[159, 145]]).max() < 0.2  # the subject's right eye stays open
    smile = moved("mouthSmileLeft", "mouthSmileRight")
    assert smile[61, 1] > 3 and smile[291, 1] > 3 and smile[291, 0] > 2 > -2 > smile[61, 0]
    tongue = full_expression(model, "tongueOut") - rest
    assert (np.abs(tongue).max(1) > 0).sum() < 300 and tongue[:, 2].max() > 15


def test_eyes_turn_without_tearing(model):
    """Looking aside moves an eyeball as a rigid turn about its centre, to first order."""
    eyes = np.asarray(model.region_mask("eyes")) & (np.asarray(model.mean)[:, 0] > 0)
    before = np.asarray(model.mean)[eyes]
    for name in ("eyeLookInLeft", "eyeLookOutLeft", "eyeLookUpLeft", "eyeLookDownLeft"):
        after = full_expression(model, name)[eyes]
        p, q = before - before.mean(0), after - after.mean(0)
        u, _, vt = np.linalg.svd(p.T @ q)
        residual = np.linalg.norm(p @ (u @ vt) - q, axis=1)
        moved = np.linalg.norm(after - before, axis=1).max()
        assert moved > 1.0 and residual.max() < 0.35 * moved, name


def test_albedo_spans_dark_and_light_skin(model):
    skin = np.asarray(model.region_mask("cheeks", "forehead"))
    mean = np.asarray(model.albedo_mean)
    assert mean.min() > 0 and mean.max() < 1
    tone = [
        float(np.median(np.asarray(model.reflectance(jnp.zeros(model.albedo.count).at[0].set(z)))
                        [skin] @ [0.2126, 0.7152, 0.0722]))
        for z in (-2.0, 0.0, 2.0)
    ]  # fmt: skip
    low, high = min(tone), max(tone)
    assert 0.005 < low < 0.08 and 0.35 < high < 0.75 and low < tone[1] < high
    eyes = np.asarray(model.region_mask("eyes"))
    assert mean[eyes].min() < 0.02 and mean[eyes].max() > 0.4  # pupil and sclera


def test_brows_are_darker_than_the_forehead(model):
    points = np.asarray(model.landmarks468.vertices)
    albedo = np.asarray(model.albedo_mean).mean(1)
    brow = model.landmarks468(model.albedo_mean)
    middle = np.asarray(brow)[[105, 66, 52, 65, 334, 296, 282, 295]].mean()
    forehead = np.median(albedo[np.asarray(model.region_mask("forehead"))])
    assert points.shape == (468, 3)
    assert middle < 0.9 * forehead
    # Painted from the front: the back of the head stays smooth at the brows' height.
    mean, faces = np.asarray(model.mean), np.asarray(model.faces)
    back = (np.asarray(model.region_mask("scalp")) & (mean[:, 2] < -20))[faces].all(1)
    ratio = albedo[faces[back, 0]] / albedo[faces[back, 1]]
    assert ratio.min() > 0.75 and ratio.max() < 1 / 0.75


def test_subdivision_keeps_shape_landmarks_and_coefficients(model):
    fine = subdivide(model)
    assert 16000 < fine.vertex_count < 20000
    z = jnp.asarray(np.random.default_rng(2).normal(size=model.identity.count))
    none = jnp.zeros(52)
    for points, finer in ((model.landmarks68, fine.landmarks68),
                          (model.landmarks468, fine.landmarks468)):  # fmt: skip
        assert points is not None and finer is not None
        shift = np.linalg.norm(
            np.asarray(points(model.shape(z, none)) - finer(fine.shape(z, none))), axis=1
        )
        assert shift.mean() < 0.3 and shift.max() < 1.5  # smoothing, mm
    area, area_fine = (skin_area(m) for m in (model, fine))
    assert area_fine == pytest.approx(area, rel=0.05)
    assert (signed_areas(np.asarray(fine.uv), np.asarray(fine.uv_faces)) > 0).mean() > 0.99


def skin_area(model: MorphableModel) -> float:
    faces = np.asarray(model.faces)
    skin = np.asarray(model.region_mask("forehead", "cheeks", "chin", "nose", "scalp"))
    a, b, c = (np.asarray(model.mean)[faces[skin[faces].all(1), i]] for i in range(3))
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)
