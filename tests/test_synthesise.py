"""Texture synthesis: its energies against finite differences, and what a small run does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from jaxface.energies._gram import StyleTargets, grams
from jaxface.energies.known_detail import KnownDetail, photo_detail_energy, plain_detail_energy
from jaxface.imaging.low_pass import low_pass
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.stages.texture._synthesise import (
    SynthesisProblem,
    SynthesisWeights,
    synthesis_energy,
    synthesise,
)
from jaxface.stages.texture.detail import soft_inside, with_complexion, with_intensity, with_photo

LAYERS = ("conv1_1", "conv2_1", "conv3_1")


@pytest.fixture(scope="module")
def network():
    return random_network(((2, 8), (2, 16), (1, 16)), seed=3)


def texture(size=48, seed=0):
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(size, size))
    smooth = np.asarray(low_pass(jnp.asarray(noise, jnp.float32), 1.5))
    return jnp.asarray(0.5 + 0.4 * smooth, jnp.float32)


def problem_of(network, target, start, *, photo=0.0, weight=None, free=None, detail=None):
    zeros = jnp.zeros_like(start)
    known = KnownDetail(
        target if weight is None else start,
        zeros if weight is None else weight,
        start,
        jnp.ones_like(start) if detail is None else detail,
        jnp.asarray(1.0, start.dtype),
    )
    return SynthesisProblem(
        network,
        StyleTargets(grams(target, network, layers=LAYERS)),
        jnp.ones(start.shape, bool) if free is None else free,
        known,
        SynthesisWeights(photo=photo),
    )


def test_energy_vanishes_on_the_target_itself(network):
    target = texture()
    total, terms = synthesis_energy().value(target, problem_of(network, target, target))
    assert float(total) < 1e-6
    assert set(terms) == {"style", "photo", "plain"}


def test_each_term_is_reported_with_its_own_weight(network):
    target, start = texture(16, 0), texture(16, 1)
    free = jnp.ones((16, 16), bool).at[:, :4].set(False)
    problem = problem_of(
        network, target, start, photo=2.0, weight=jnp.ones((16, 16)), free=free,
        detail=jnp.zeros((16, 16)),
    )  # fmt: skip
    image = start + 0.1
    total, terms = synthesis_energy().value(image, problem)
    held = jnp.where(free, image, start)
    plain = SynthesisWeights().plain * plain_detail_energy(held, problem.known)
    assert float(terms["photo"]) == pytest.approx(
        2 * float(photo_detail_energy(held, problem.known))
    )
    assert float(terms["plain"]) == pytest.approx(float(plain))
    assert float(plain) == pytest.approx(30 * 0.1**2 * 16 * 12, rel=1e-4)
    assert float(total) == pytest.approx(sum(float(value) for value in terms.values()))


def test_gradient_in_both_modes(network, x64):
    wide = jax.tree.map(lambda x: jnp.asarray(np.asarray(x), jnp.float64), network)
    target, start = (jnp.asarray(np.asarray(texture(16, s)), jnp.float64) for s in (0, 1))
    problem = problem_of(
        wide, target, start, photo=0.7, weight=0.5 * jnp.ones((16, 16)),
        detail=0.5 * jnp.ones((16, 16)),
    )  # fmt: skip
    energy = synthesis_energy(method="direct")
    check_grads(
        lambda image: energy.value(image, problem)[0], (start + 0.01,), 1, ("fwd", "rev"),
        atol=1e-3, rtol=1e-5, eps=1e-6,
    )  # fmt: skip


def test_statistics_come_close_to_those_of_another_texture(network):
    target, start = texture(48, 0), 0.5 + 0.02 * (texture(48, 1) - 0.5)
    found = synthesise(start, problem_of(network, target, start), steps=60)
    assert found.values[-1] < 0.02 * found.values[0]
    assert (np.diff(found.values) <= 0).all()
    image = np.asarray(found.image)
    assert image.min() > 0 and image.max() < 1
    assert found.terms["style"] == pytest.approx(found.values[-1], rel=1e-3)


def test_what_is_not_free_stays(network):
    target, start = texture(32, 0), texture(32, 1)
    free = jnp.zeros((32, 32), bool).at[8:24, 8:24].set(True)
    found = synthesise(start, problem_of(network, target, start, free=free), steps=5)
    changed = np.abs(np.asarray(found.image - start)) > 1e-6
    assert changed[8:24, 8:24].any()
    assert not changed[~np.asarray(free)].any()


def test_the_photo_holds_its_frequencies(network):
    target, start = texture(32, 0), texture(32, 1)
    weight = jnp.zeros((32, 32)).at[:, :16].set(1.0)
    loose = synthesise(start, problem_of(network, target, start), steps=30).image
    held = synthesise(
        start, problem_of(network, target, start, photo=1e6, weight=weight), steps=30
    ).image  # fmt: skip

    def moved(image):
        return float(jnp.abs(low_pass(weight * (image - start), 1.0)).mean())

    assert moved(held) < 0.2 * moved(loose)


def test_a_stop_from_outside_and_pictures_on_the_way(network):
    target, start = texture(32, 0), texture(32, 1)
    seen = []

    def on_step(step, value, image):
        seen.append(np.asarray(image()))
        return step == 3

    found = synthesise(start, problem_of(network, target, start), steps=50, on_step=on_step)
    assert len(seen) == 3 and len(found.values) == 4
    np.testing.assert_allclose(seen[-1], found.image, atol=1e-6)


def test_wrong_input_is_told(network):
    target = texture(32)
    with pytest.raises(ValueError, match="one shape"):
        synthesise(target[:16], problem_of(network, target, target))
    with pytest.raises(ValueError, match="not finite"):
        synthesise(target.at[0, 0].set(jnp.nan), problem_of(network, target, target))


def test_known_detail_is_its_definition_and_differentiable_at_rest(x64):
    rng = np.random.default_rng(0)
    photo, weight, low, detail = (jnp.asarray(rng.uniform(size=(9, 11))) for _ in range(4))
    known = KnownDetail(photo, weight, low, detail, 0.0)
    image = jnp.asarray(rng.uniform(size=(9, 11)))
    held = jnp.sum(weight * (weight * (image - photo)) ** 2)
    assert float(photo_detail_energy(image, known)) == pytest.approx(float(held), rel=1e-10)
    plain = jnp.sum((1 - detail) * (image - low) ** 2)
    assert float(plain_detail_energy(image, known)) == pytest.approx(float(plain), rel=1e-10)
    same = KnownDetail(image, weight, image, detail, jnp.array(1.2))
    unseen = KnownDetail(photo, 0 * weight, low, 1 + 0 * detail, jnp.array(1.2))
    for energy in (photo_detail_energy, plain_detail_energy):
        for data in (same, unseen):
            check_grads(energy, (image, data), 1, ("fwd", "rev"), eps=1e-6)
        gradient = jax.grad(energy)(image, same)
        np.testing.assert_allclose(gradient, 0.0, atol=1e-14)


@settings(deadline=None, max_examples=10)
@given(scale=st.floats(0.1, 10.0), blur=st.floats(0.0, 3.0), seed=st.integers(0, 99))
def test_known_detail_grows_with_the_square_of_the_distance(scale, blur, seed):
    rng = np.random.default_rng(seed)
    photo, weight, low, detail, away = (
        jnp.asarray(rng.uniform(size=(9, 11)), jnp.float32) for _ in range(5)
    )
    known = KnownDetail(photo, weight, low, detail, jnp.asarray(blur, jnp.float32))
    for energy, rest in ((photo_detail_energy, photo), (plain_detail_energy, low)):
        one, scaled = (float(energy(rest + s * away, known)) for s in (1.0, scale))
        assert one >= 0 and float(energy(rest, known)) == 0
        assert scaled == pytest.approx(scale**2 * one, rel=1e-3)


@settings(deadline=None, max_examples=20)
@given(st.floats(0.3, 3.0), st.integers(0, 1000))
def test_low_pass_keeps_the_sum_and_shrinks_the_spread(blur, seed):
    image = np.zeros((48, 48), np.float32)
    image[16:32, 16:32] = np.random.default_rng(seed).uniform(size=(16, 16))
    smooth = np.asarray(low_pass(jnp.asarray(image), blur))
    assert smooth.sum() == pytest.approx(image.sum(), rel=2e-3)
    assert (smooth**2).sum() <= (image**2).sum()


def test_detail_moves_to_another_complexion():
    rng = np.random.default_rng(0)
    pores = 1 - 0.2 * (rng.uniform(size=(64, 64, 1)) > 0.9)
    own, other = np.array([0.3, 0.2, 0.15]), np.array([0.8, 0.6, 0.5])
    moved = np.asarray(
        with_complexion(jnp.asarray(own * pores), jnp.asarray(other * np.ones_like(pores)), 6.0)
    )
    inner = slice(16, 48)
    np.testing.assert_allclose(moved[inner, inner].mean((0, 1)), other, rtol=0.02)
    contrast = moved[inner, inner].std((0, 1)) / moved[inner, inner].mean((0, 1))
    np.testing.assert_allclose(
        contrast, pores[inner, inner].std() / pores[inner, inner].mean(), rtol=0.1
    )


def test_the_photo_replaces_low_frequencies_alone():
    rng = np.random.default_rng(0)
    fine = 0.02 * rng.choice([-1.0, 1.0], size=(64, 64, 1))
    own = jnp.asarray(0.4 + fine * np.ones(3))
    photo = jnp.full((64, 64, 3), 0.6)
    mixed = np.asarray(with_photo(own, photo, jnp.ones((64, 64)), 3.0))[16:48, 16:48]
    np.testing.assert_allclose(mixed.mean(), 0.6, atol=0.01)
    np.testing.assert_allclose(mixed.std(), 0.02, rtol=0.2)
    unseen = with_photo(own, photo, jnp.zeros((64, 64)), 3.0)
    np.testing.assert_allclose(unseen, own, atol=1e-6)


def test_intensity_is_replaced_and_hue_kept():
    colour = jnp.full((4, 4, 3), jnp.array([0.6, 0.45, 0.4]))
    answer = np.asarray(with_intensity(colour, jnp.full((4, 4), 0.3)))
    np.testing.assert_allclose(answer @ [0.299, 0.587, 0.114], 0.3, atol=1e-5)
    np.testing.assert_allclose(answer / answer[..., :1], colour / colour[..., :1], rtol=1e-3)


def test_the_mask_is_soft_inwards():
    free = jnp.zeros((20, 20), bool).at[4:16, 4:16].set(True)
    soft = np.asarray(soft_inside(free, 4))
    assert not soft[~np.asarray(free)].any()
    assert soft[10, 10] == 1 and 0 < soft[5, 10] < soft[6, 10] < 1
