"""One photo through all stages; the only place that sequences them.

Each step is a function of its own and can be replaced: give landmarks, a mask, a model or terms
of your own, or call the stages yourself.
"""

from jaxface.pipeline._digitize import digitize
from jaxface.pipeline.cluster import digitize_on_cluster
from jaxface.pipeline.fitting._detail_levels import detail_levels
from jaxface.pipeline.fitting._fit import fit
from jaxface.pipeline.fitting.fitted_face import FittedFace
from jaxface.pipeline.fitting.outputs import save_fit
from jaxface.pipeline.fitting.partial import Texture
from jaxface.pipeline.folder import FolderEntry, digitize_folder, shard_of
from jaxface.pipeline.options import DigitizeOptions
from jaxface.pipeline.photo import as_photo, open_photo, photos_in
from jaxface.pipeline.texture._complete import complete
from jaxface.pipeline.texture.folder import complete_folder
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.run.clock import Clock
from jaxface.stages.fit import FitWeights
from jaxface.stages.fit.options import FitOptions

__all__ = [
    "Clock",
    "CompletionOptions",
    "DigitizeOptions",
    "FitOptions",
    "FitWeights",
    "FittedFace",
    "FolderEntry",
    "Texture",
    "as_photo",
    "complete",
    "complete_folder",
    "detail_levels",
    "digitize",
    "digitize_folder",
    "digitize_on_cluster",
    "fit",
    "open_photo",
    "photos_in",
    "save_fit",
    "shard_of",
]
