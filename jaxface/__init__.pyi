from . import energies, networks, render, solvers, stages
from .energies.term import Term, compose
from .io.face_models import load_model
from .pipeline._digitize import digitize
from .pipeline.databases.from_photos import build_database
from .pipeline.fitting._fit import fit
from .pipeline.fitting.outputs import save_fit
from .pipeline.fitting.partial import texture
from .pipeline.folder import digitize_folder
from .pipeline.options import DigitizeOptions
from .pipeline.texture._complete import complete
from .pipeline.texture.folder import complete_folder
from .pipeline.texture.options import CompletionOptions
from .run.compile_cache import enable_compilation_cache
from .stages.fit import FitOptions, FitWeights
from .stages.landmarks import detect_faces
from .stages.texture._synthesise_texture import synthesise_texture

__version__: str

__all__ = [
    "CompletionOptions",
    "DigitizeOptions",
    "FitOptions",
    "FitWeights",
    "Term",
    "__version__",
    "build_database",
    "complete",
    "complete_folder",
    "compose",
    "detect_faces",
    "digitize",
    "digitize_folder",
    "enable_compilation_cache",
    "energies",
    "fit",
    "load_model",
    "networks",
    "render",
    "save_fit",
    "solvers",
    "stages",
    "synthesise_texture",
    "texture",
]
