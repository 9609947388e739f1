from ._cast_shadows import cast_shadows
from ._posterior import Posterior, posterior
from .batch import fit_batch
from .levels import fit_parameters, level_stages, through_levels
from .objective import fit_energy, weights_as_data
from .options import FitOptions, FitOverrides
from .photo import WorkingPhoto, in_units_of, input_shapes, working_photo
from .prepared import FitModel, prepare
from .records import (
    FitConfig,
    FitData,
    FitInput,
    FitStats,
    FitWeights,
    LevelRecord,
    no_history,
)
from .rendering import FitRender, brow_map, fit_hidden_shading, render_fit, skin_map
from .solve import fit_level, fit_shadows, observe, observe_finest
from .start import fit_start

__all__ = [
    "FitConfig",
    "FitData",
    "FitInput",
    "FitModel",
    "FitOptions",
    "FitOverrides",
    "FitRender",
    "FitStats",
    "FitWeights",
    "LevelRecord",
    "Posterior",
    "WorkingPhoto",
    "brow_map",
    "cast_shadows",
    "fit_batch",
    "fit_energy",
    "fit_hidden_shading",
    "fit_level",
    "fit_parameters",
    "fit_shadows",
    "fit_start",
    "in_units_of",
    "input_shapes",
    "level_stages",
    "no_history",
    "observe",
    "observe_finest",
    "posterior",
    "prepare",
    "render_fit",
    "skin_map",
    "through_levels",
    "weights_as_data",
    "working_photo",
]
