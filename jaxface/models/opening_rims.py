"""Where the skin turns inwards at eyes and mouth, and the colour that it should have there.

Painted and averaged textures show the pockets behind the lids in a plain red and teeth on the lips'
inner rim, which a texture of the skin must not continue.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy.spatial import KDTree

from jaxface._types import Array, Float
from jaxface.imaging.masks import smoothstep
from jaxface.models.morphable import MorphableModel

LID_SHADE = 0.85
"""albedo of a pocket, of the lids'"""

RIM = (4.0, 6.0)
"""mm from the mouth's interior within which lips are rim, and beyond which they are not"""


class OpeningRims(eqx.Module):
    """Weights of a model's vertices, 0 to 1; all 0 where it names no lids or lips."""

    pocket: Float[Array, "n"]
    """behind the lids"""
    lid: Float[Array, "n"]
    """skin of the lids, normalised to sum 1"""
    pale: Float[Array, "n"]
    """on the lips' inner rim and paler than they are"""
    lip: Float[Array, "n"]
    """lips, normalised to sum 1"""

    def calm(self, albedo: Float[Array, "n 3"]) -> Float[Array, "n 3"]:
        """An albedo (linear RGB) with pockets and rims in the colour of lids and lips."""
        lid, lip = LID_SHADE * (self.lid @ albedo), self.lip @ albedo
        return (
            albedo
            + self.pocket[:, None] * (lid - albedo)
            + self.pale[:, None] * (lip - albedo)
        )  # fmt: skip


def opening_rims(model: MorphableModel) -> OpeningRims:
    """The rims of a model, found by its regions and its mean albedo."""
    albedo = np.asarray(model.albedo_mean, np.float64)
    names = model.region_names
    pocket, lid, pale, lip = (np.zeros(len(albedo)) for _ in range(4))
    if "eyelids" in names:
        lids = np.asarray(model.region_mask("eyelids"))
        redness = np.log(np.maximum(albedo[:, 0], 1e-3) / np.maximum(albedo[:, 1], 1e-3))
        pocket = lids * smoothstep(redness - np.quantile(redness[lids], 0.3), 0.2, 0.6)
        lid = lids * (1 - pocket)
    if "lips" in names and "mouth_interior" in names:
        lips, interior = (np.asarray(model.region_mask(n)) for n in ("lips", "mouth_interior"))
        mean = np.asarray(model.mean, np.float64)
        distance = np.asarray(KDTree(mean[interior]).query(mean)[0])
        tone = albedo.mean(axis=1) / np.median(albedo[lips].mean(axis=1))
        pale = lips * smoothstep(-distance, -RIM[1], -RIM[0]) * smoothstep(tone, 1.05, 1.25)
        lip = lips * (np.abs(tone - 1) < 0.15)
    parts = pocket, lid / max(lid.sum(), 1e-6), pale, lip / max(lip.sum(), 1e-6)
    return OpeningRims(*(jnp.asarray(part, jnp.float32) for part in parts))
