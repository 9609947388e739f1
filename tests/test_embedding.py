"""Landmarks of a topology found by rendering it: against the bundled model's own."""

import equinox as eqx
import numpy as np
import pytest

from jaxface.geometry.closest_point import closest_weights
from jaxface.io.face_models.model_file import load_bundled
from jaxface.stages.landmarks import detect_faces
from jaxface.stages.scan._embed_landmarks import embed_landmarks, with_landmarks


def test_two_views_find_most_of_the_bundled_landmarks():
    model = load_bundled("makehuman")
    bare = eqx.tree_at(lambda m: (m.landmarks68, m.landmarks468), model, (None, None))
    found = embed_landmarks(bare, detect_faces, yaws=(0.0, 15.0))
    assert found.views == len(found.looks) == 2
    assert model.landmarks468 is not None and model.landmarks68 is not None
    distance = np.linalg.norm(
        np.asarray(found.points(model.mean) - model.landmarks468(model.mean)), axis=1
    )
    assert np.median(distance) < 2.0  # 1.26 mm measured
    assert np.median(found.spread) < 1.4  # 0.83
    complete = with_landmarks(bare, found.points)
    assert complete.landmarks68 is not None
    inner = np.asarray(complete.landmarks68(model.mean) - model.landmarks68(model.mean))[17:]
    assert np.median(np.linalg.norm(inner, axis=1)) < 1.6  # 0.98


@pytest.mark.slow
def test_finds_the_bundled_landmarks_again():
    model = load_bundled("makehuman")
    bare = eqx.tree_at(lambda m: (m.landmarks68, m.landmarks468), model, (None, None))
    found = embed_landmarks(bare, detect_faces, yaws=(-15.0, 0.0, 15.0))
    assert found.views == 3
    assert model.landmarks468 is not None and model.landmarks68 is not None
    distance = np.linalg.norm(
        np.asarray(found.points(model.mean) - model.landmarks468(model.mean)), axis=1
    )
    assert np.median(distance) < 3.0
    complete = with_landmarks(bare, found.points)
    assert complete.landmarks68 is not None
    inner = np.asarray(complete.landmarks68(model.mean) - model.landmarks68(model.mean))[17:]
    assert np.median(np.linalg.norm(inner, axis=1)) < 3.0


@pytest.mark.slow
def test_points_on_openings_stay_on_the_outside():
    # Without eyeballs and inner mouth a pixel in an opening shows the inside of the head.
    model = load_bundled("makehuman")
    hollow = model.region_mask("eyes", "mouth_interior")[model.faces].any(axis=1)
    kept = np.flatnonzero(~np.asarray(hollow))
    change = (model.faces[kept], model.uv_faces[kept], None, None)
    open_eyed = eqx.tree_at(lambda m: (m.faces, m.uv_faces, m.quads, m.uv_quads), model, change)
    found = embed_landmarks(open_eyed, detect_faces, yaws=(-15.0, 0.0, 15.0))
    assert model.landmarks468 is not None
    distance = np.linalg.norm(
        np.asarray(found.points(model.mean) - model.landmarks468(model.mean)), axis=1
    )
    assert np.percentile(distance, 97) < 12.0 and distance.max() < 40.0


@pytest.mark.slow
def test_a_model_seen_from_behind_is_refused():
    model = load_bundled("makehuman")
    turned = model.mean * np.array([-1.0, 1.0, -1.0], np.float32)
    with pytest.raises(ValueError, match="finds a face in 0 of 2"):
        embed_landmarks(
            eqx.tree_at(lambda m: m.mean, model, turned), detect_faces, yaws=(0.0, 15.0)
        )


def test_closest_point_of_a_triangle_against_a_dense_search():
    rng = np.random.default_rng(0)
    corners = rng.normal(size=(6, 3, 3))
    steps = np.linspace(0, 1, 60)
    u, v = np.meshgrid(steps, steps)
    inside = u + v <= 1
    dense = np.stack([1 - u - v, u, v], axis=-1)[inside]
    for place in rng.normal(size=(5, 3)) * 1.5:
        weights = closest_weights(np.tile(place, (6, 1)), corners)
        assert (weights >= -1e-9).all()
        np.testing.assert_allclose(weights.sum(axis=1), 1.0)
        for triangle, w in zip(corners, weights, strict=True):
            best = np.linalg.norm(dense @ triangle - place, axis=1).min()
            assert np.linalg.norm(w @ triangle - place) <= best + 1e-9
            assert np.linalg.norm(w @ triangle - place) >= best - 0.1
