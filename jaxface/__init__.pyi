from . import energies, networks, render, solvers, stages
from .energies.term import Term, compose
from .io.face_models import load_model
from .pipeline._digitize import digitize
from .pipeline.databases.from_photos import build_database
from .pipeline.fitting._fit import fit
from .pipeline.fitting.outputs import save_fit
from .pipeline.texture._complete import complete
from .pipeline.texture.folder import complete_folder
from .pipeline.texture.partial import texture
from .stages.fit import FitWeights
from .stages.landmarks import detect_faces
from .stages.texture._synthesise_texture import synthesise_texture

__version__: str

__all__ = [
    "FitWeights",
    "Term",
    "__version__",
    "build_database",
    "complete",
    "complete_folder",
    "compose",
    "detect_faces",
    "digitize",
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
