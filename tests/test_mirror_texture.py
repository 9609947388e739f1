import jax.numpy as jnp
import numpy as np

from jaxface.geometry.uv import uv_layout
from jaxface.io.face_models import load_model
from jaxface.stages.texture.mirror import GUESS, ROWS, fill_from_mirror, mirror_uv, with_other_side

SIDE = 300  # not a multiple of the rows that are computed at once


def face_and_layout():
    model = load_model("makehuman")
    layout = uv_layout(model.uv, model.uv_faces, SIDE)
    triangle = np.maximum(np.asarray(layout.triangle), 0)
    cheeks = np.asarray(model.region_mask("cheeks"))[np.asarray(model.faces)].all(1)[triangle]
    return model, layout, cheeks & np.asarray(layout.inside)


def test_mirror_image_of_the_mirror_image_is_the_texel():
    model, layout, cheeks = face_and_layout()
    uv = mirror_uv(model, layout)[cheeks]
    assert np.isfinite(uv).all()
    rows, columns = np.nonzero(cheeks)
    # The bundled layout is symmetric about its middle.
    np.testing.assert_allclose(uv[:, 0], 1 - (columns + 0.5) / SIDE, atol=1.5 / SIDE)
    np.testing.assert_allclose(uv[:, 1], 1 - (rows + 0.5) / SIDE, atol=1.5 / SIDE)


def test_a_hidden_half_gets_the_others_detail_on_its_own_low_frequencies():
    model, layout, cheeks = face_and_layout()
    assert SIDE % ROWS
    left = np.broadcast_to(np.arange(SIDE) < SIDE // 2 - 10, (SIDE, SIDE))
    stripes = 1 + 0.2 * np.sin(np.arange(SIDE) / 6)[:, None, None]
    low = np.where(left[..., None], 0.4, 0.3) * np.array([1.0, 0.8, 0.6])
    albedo = np.where(left[..., None], stripes * low, 9.0)
    arrays = (jnp.asarray(x, jnp.float32) for x in (albedo, left, low, mirror_uv(model, layout)))
    whole, borrowed = map(np.asarray, fill_from_mirror(*arrays))
    seen = cheeks & left
    hidden = cheeks & (np.arange(SIDE) > SIDE // 2 + 14)
    np.testing.assert_allclose(whole[seen], albedo[seen], rtol=1e-5)
    np.testing.assert_allclose(whole[hidden], (stripes * low)[hidden], atol=0.01)
    np.testing.assert_allclose(borrowed[hidden], 1.0, atol=1e-3)
    assert not borrowed[seen].any()


def test_hidden_side_gets_the_colour_of_the_other_and_the_seen_side_keeps_its_own():
    model, layout, cheeks = face_and_layout()
    left = np.broadcast_to(np.arange(SIDE) < SIDE // 2 - 10, (SIDE, SIDE))
    colour = np.linspace(0.2, 0.6, SIDE)[:, None, None] * np.array([1.0, 0.8, 0.6])
    albedo = np.where(left[..., None], np.broadcast_to(colour, (SIDE, SIDE, 3)), 7.0)
    found, weight = with_other_side(
        jnp.asarray(albedo, jnp.float32),
        jnp.asarray(left, jnp.float32),
        jnp.asarray(mirror_uv(model, layout)),
    )
    seen = cheeks & left
    hidden = cheeks & (np.arange(SIDE) > SIDE // 2 + 14)
    np.testing.assert_allclose(np.asarray(weight)[seen], 1.0)
    np.testing.assert_allclose(np.asarray(found)[seen], albedo[seen], rtol=1e-5)
    np.testing.assert_allclose(np.asarray(weight)[hidden], GUESS, atol=1e-3)
    expected = np.broadcast_to(colour, albedo.shape)[hidden]
    np.testing.assert_allclose(np.asarray(found)[hidden], expected, atol=0.01)
