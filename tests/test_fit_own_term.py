"""A term of one's own that is no number ends the fit of a photo, and is named."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxface.energies.term import Term
from jaxface.io.face_models.model_file import load_bundled
from jaxface.pipeline import fit


@pytest.mark.slow
def test_a_term_that_is_no_number_is_named():
    """Without a word the photo would count for nothing, and the landmarks alone would decide."""
    model = load_bundled("makehuman")
    assert model.landmarks68 is not None
    points = np.asarray(model.landmarks68(model.mean))
    points = 32 + 0.2 * (points[:, :2] - points[:, :2].mean(axis=0)) * [1, -1]
    photo = np.full((64, 64, 3), 0.5, np.float32)
    term = Term("mine", lambda y, data: jnp.sqrt(-1.0 - y.light[0, 0] ** 2))
    with jax.debug_nans(False), pytest.raises(ValueError, match="the value.* of 'mine'"):
        fit(
            photo, model, landmarks=points, size=64, steps=(1,), details=(0,),
            self_shadow=False, extra_terms=[term],
        )  # fmt: skip
