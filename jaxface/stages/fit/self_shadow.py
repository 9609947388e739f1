"""A model that knows what its mean face hides from itself, or one that does not."""

import dataclasses

from jaxface.models.morphable import MorphableModel
from jaxface.render.occlusion import self_occlusion


def with_self_shadow(model: MorphableModel, wanted: bool) -> MorphableModel:
    """The model with ``occlusion``, its own or else that of its mean face; or with none.

    Args:
        model: any morphable model.
        wanted: whether it shall have it.
    """
    if not wanted:
        return dataclasses.replace(model, occlusion=None, occlusion_slope=None)
    if model.occlusion is not None:
        return model
    return dataclasses.replace(model, occlusion=self_occlusion(model.mean, model.faces))
