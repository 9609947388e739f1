"""The page on composing energies: its code runs in order, and what it says of the answers is so."""

import re
import warnings
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxface
from jaxface.pipeline import fit
from jaxface.stages.fit import FitOptions
from tests.small_fit import small_face, small_photo

PAGE = Path(__file__).resolve().parent.parent / "docs" / "compose.md"


def run_blocks(opening: str, names: dict) -> dict:
    """The page's blocks of one kind in one namespace, as a reader would type them."""
    bodies = re.findall(rf"^```{opening}\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    assert bodies
    with warnings.catch_warnings(), jax.debug_nans(False):
        warnings.filterwarnings("ignore", "JAXopt is no longer maintained", DeprecationWarning)
        for number, body in enumerate(bodies):
            exec(compile(body, f"compose.md, {opening} block {number + 1}", "exec"), names)
    return names


@pytest.fixture(scope="module")
def page() -> dict:
    return run_blocks("python", {})


def test_every_solver_finds_the_same(page):
    assert set(page["lengths"]) == {
        "gauss_newton", "optimistix.least_squares", "optimistix.minimise", "jaxopt.LBFGS",
        "optax.adam",
    }  # fmt: skip
    for name, found in page["lengths"].items():
        np.testing.assert_allclose(found, page["lengths"]["gauss_newton"], rtol=2e-3, err_msg=name)


def test_every_solver_has_the_same_derivative(page):
    """That of the answers: a parabola through the three weights has it in the middle."""
    w, found = np.asarray(page["priors"], float), np.asarray(page["lengths"]["gauss_newton"], float)
    slope = np.polyval(np.polyder(np.polyfit(np.log(w), found, 2)), 0.0)
    for name, slopes in page["slopes"].items():
        np.testing.assert_allclose(slopes[1], slope, rtol=0.1, err_msg=name)
        np.testing.assert_allclose(slopes, page["slopes"]["gauss_newton"], rtol=1e-2, err_msg=name)


def test_a_sweep_compiles_once(page):
    assert page["fitted_length"]._cache_size() == 1
    assert all(a > b for a, b in zip(page["swept"], page["swept"][1:], strict=False))


def test_terms_are_reported_and_differentiated(page):
    assert set(page["parts"]) == {"markers", "prior"}
    assert float(page["total"]) == pytest.approx(float(sum(page["parts"].values())))
    assert set(page["slope"]) == {"identity", "scale", "shift"}


def test_a_scalar_through_renderer_and_network_falls(page):
    found = page["found"]
    assert set(found.stats["aux"]) == {"markers", "prior", "style"}
    assert found.stats["values"][-1] < 0.5 * found.stats["values"][0]
    assert float(abs(found.value["light"] - page["ambient_light"](1.0)).max()) > 1e-2


def test_a_term_is_replaced_by_name(page):
    before = page["equation"].value(page["face"], page["detected"])[1]
    assert set(page["values"]) == set(before) == {"landmark", "prior"}
    np.testing.assert_allclose(page["values"]["landmark"], before["landmark"], rtol=1e-5)
    assert page["replaced"].terms[1].fn is page["huber_prior"]


def test_reweighting_between_steps_withstands_outliers(page):
    plain, robust = page["errors"]
    assert robust < 0.3 * plain


def test_what_is_not_finite_is_named(page):
    assert page["reason"](page["stopped"]).endswith("the gradient and the curvature of 'kink'")
    assert page["message"].startswith("my fit met numbers that are not finite")


@pytest.mark.slow
def test_the_blocks_that_fit_a_photo_run(page, monkeypatch):
    """On a small face in place of the photo."""
    model = small_face()
    photo, points, _ = small_photo(model)
    quick = FitOptions(size=64, steps=(12,), details=(0,), self_shadow=False, compared_pixels=1000)

    def small(path, **given):
        assert path == "photo.jpg"
        return fit(photo, model, quick, landmarks=points, mask=np.ones(photo.shape[:2]), **given)

    monkeypatch.setattr(jaxface, "fit", small)
    names = run_blocks(r"\{ \.python \.no-run \}", dict(page))
    fitted, found = names["fitted"], names["found"]
    energy, y0, data = names["squares"], names["y0"], names["data"]
    assert energy.terms[0].fn is names["squared_photo"]
    assert float(energy.total(found.value, data)) < float(energy.total(y0, data))
    goal = fitted.parameters.identity + 1.0
    away = [float(np.sum((f.parameters.identity - goal) ** 2)) for f in names["fits"]]
    assert away[0] > away[1] > away[2]
