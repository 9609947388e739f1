"""Feature statistics of a photo as a blend of a database's (Saito 2017, section 4)."""

from jaxface.stages.blending.baselines import nearest_subject, unconstrained
from jaxface.stages.blending.mixing import blended_grams
from jaxface.stages.blending.solve import Blend, blend, blend_reduced, reduce_database
from jaxface.stages.blending.weights import blend_weights

__all__ = [
    "Blend",
    "blend",
    "blend_reduced",
    "blend_weights",
    "blended_grams",
    "nearest_subject",
    "reduce_database",
    "unconstrained",
]
