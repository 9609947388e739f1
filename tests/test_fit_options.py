"""The settings of a fit: each default in one place, wrong ones told, the paper's at one word."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxface
from jaxface.energies.term import Term
from jaxface.models.parameters import PARAMETER_NAMES
from jaxface.pipeline.databases.from_photos import build_database
from jaxface.stages.fit import (
    FitConfig,
    FitOptions,
    FitOverrides,
    FitWeights,
    fit_energy,
    observe_finest,
    prepare,
    render_fit,
    weights_as_data,
    working_photo,
)
from tests.small_fit import small_face, small_photo


def test_defaults_are_those_of_the_stage():
    assert FitOptions().config() == FitConfig()
    assert FitOptions().weights == FitWeights()
    assert not FitOptions().changed()


def test_keywords_are_the_fields():
    names = {field.name for field in dataclasses.fields(FitOptions)}
    assert set(FitOverrides.__annotations__) == names


def test_a_misspelt_option_is_a_type_error(tmp_path):
    with pytest.raises(TypeError, match="stpes"):
        jaxface.fit(np.zeros((64, 64, 3), np.uint8), **{"stpes": (3,)})
    with pytest.raises(TypeError, match="stpes"):
        build_database(tmp_path, tmp_path / "db", licence="CC0-1.0", **{"stpes": (3,)})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"steps": ()}, r"steps \(\)"),
        ({"steps": (1.5,)}, r"steps \(1.5,\)"),
        ({"steps": (3, 2, 1), "size": 66}, "halves 2 times"),
        ({"size": 32}, "size of 64 or more"),
        ({"details": (1, 0, 2)}, "not decreasing"),
        ({"details": (0, 1)}, "3 subdivision counts"),
        ({"freeze": ("shape",)}, r"freeze is \['shape'\]"),
        ({"freeze": "light"}, "a sequence is needed"),
        ({"freeze": PARAMETER_NAMES}, "not all of them"),
        ({"focal": 0.0}, "focal is 0.0"),
        ({"focal": float("nan")}, "focal is nan"),
        ({"face": -1}, "face is -1"),
        ({"compared_pixels": 0}, "compared_pixels is 0"),
        ({"shadow_directions": 2.5}, "shadow_directions is 2.5"),
        ({"rtol": -1.0}, "rtol is -1.0"),
        ({"weights": {"photo": 1}}, "a FitWeights is needed"),
        ({"weights": FitWeights(prior=-1.0)}, r"weights.prior is -1.0"),
        ({"weights": FitWeights(extra={"mine": np.nan})}, "weights.mine is nan"),
        ({"extra_terms": (Term("mine", lambda y, d: 0.0, np.float32(-2)),)}, "term 'mine' is -2"),
        ({"extra_terms": (abs,)}, "a Term is needed"),
    ],
)
def test_what_does_not_fit_is_told(wrong, said):
    with pytest.raises(ValueError, match=said):
        FitOptions(**wrong)


def test_a_known_focal_length_is_held():
    options = FitOptions(focal=50.0, freeze=["translation", "identity"])
    assert options.config().freeze == ("identity", "translation", "log_focal")
    assert options.changed() == {"focal": 50.0, "freeze": ("translation", "identity")}


def test_weights_of_ones_own_terms_become_data():
    mine = Term("mine", lambda y, d: y.identity, 3.0)
    by_data = Term("by data", lambda y, d: y.identity, lambda d: d.user)
    weights, terms = weights_as_data(FitWeights(), (mine, by_data))
    assert weights.extra == {"mine": 3.0} and terms[1] is by_data
    again, same = weights_as_data(FitWeights(), (mine._replace(weight=np.float32(5)), by_data))
    assert again.extra == {"mine": 5.0} and hash(same) == hash(terms) and same == terms
    assert weights_as_data(FitWeights(extra={"mine": 7.0}), (mine,))[0].extra == {"mine": 7.0}
    with pytest.raises(ValueError, match="names .'other'.; .* .'mine'."):
        weights_as_data(FitWeights(extra={"other": 1.0}), (mine,))


def test_weights_from_text():
    assert FitWeights.from_text("landmark=20, prior=1e-5") == FitWeights(landmark=20.0, prior=1e-5)
    for text in ("landmark", "lanmark=2", "prior=-1", "prior=inf", "extra=1", ""):
        with pytest.raises(ValueError, match="NAME=NUMBER is needed"):
            FitWeights.from_text(text)


def test_as_published_is_equation_1_to_the_letter():
    """Against sums written down here, over a rendered image and the landmarks of the mesh."""
    model = small_face()
    photo, points, truth = small_photo(model)
    options = FitOptions.as_published(size=64, steps=(3,))
    assert FitOptions.as_published().weights == FitWeights.as_published()
    assert not (options.self_shadow or options.shadow_directions or options.estimate_inliers)
    mask = np.zeros(photo.shape[:2], np.float32)
    mask[24:70, 20:76] = 1
    working = working_photo(
        photo**2.2, points + 1.5, mask=mask, size=64,
        estimate_inliers=options.estimate_inliers, even_landmarks=options.even_landmarks,
    )  # fmt: skip
    data, level, config = working.data, prepare(model, 68), options.config()
    y = dataclasses.replace(truth, log_focal=truth.log_focal + np.log(96 / working.crop.side))

    def value(y, data, level):
        seen = observe_finest(y, data, level, options.weights, config)
        return fit_energy().value(y, seen), render_fit(y, level, data.principal, 64)

    (total, parts), shown = jax.jit(value)(y, data, level)
    face = np.asarray(shown.skin)
    weight = np.asarray(data.mask) * face
    distance = np.linalg.norm(np.asarray(data.image - shown.color), axis=-1)
    assert 500 < face.sum() < 64 * 64 // 2
    assert float(parts["photo"]) == pytest.approx((weight * distance).sum() / weight.sum(), 2e-3)
    mesh = level.points(model.shape(y.identity, y.expression))
    screen = np.asarray(y.camera(data.principal).project(y.pose(mesh)))[:, :2]
    away = np.linalg.norm(screen - np.asarray(data.landmarks), axis=1) / float(data.landmark_unit)
    assert float(parts["landmark"]) == pytest.approx(10 * np.mean(away**2), 1e-4)
    squares = sum(float(jnp.sum(x**2)) for x in (y.identity, y.expression, y.albedo))
    assert float(parts["prior"]) == pytest.approx(2.5e-5 * squares, 1e-5)
    assert float(parts["focal"]) == float(parts["light"]) == 0.0
    assert float(total) == pytest.approx(sum(map(float, parts.values())), 1e-6)
