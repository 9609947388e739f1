"""Photo -> fitted face (Saito 2017, section 3)."""

from jaxface.stages.fit._cast_shadows import cast_shadows
from jaxface.stages.fit._posterior import Posterior, posterior
from jaxface.stages.fit.batch import fit_batch
from jaxface.stages.fit.levels import fit_parameters, level_stages, through_levels
from jaxface.stages.fit.photo import WorkingPhoto, input_shapes, working_photo
from jaxface.stages.fit.prepared import FitModel, prepare
from jaxface.stages.fit.records import (
    FitConfig,
    FitData,
    FitInput,
    FitStats,
    FitWeights,
    LevelRecord,
)
from jaxface.stages.fit.rendering import FitRender, fit_hidden_shading, render_fit, skin_map
from jaxface.stages.fit.solve import (
    fit_energy,
    fit_level,
    fit_shadows,
    fit_start,
)

__all__ = [
    "FitConfig",
    "FitData",
    "FitInput",
    "FitModel",
    "FitRender",
    "FitStats",
    "FitWeights",
    "LevelRecord",
    "Posterior",
    "WorkingPhoto",
    "cast_shadows",
    "fit_batch",
    "fit_energy",
    "fit_hidden_shading",
    "fit_level",
    "fit_parameters",
    "fit_shadows",
    "fit_start",
    "input_shapes",
    "level_stages",
    "posterior",
    "prepare",
    "render_fit",
    "skin_map",
    "through_levels",
    "working_photo",
]
