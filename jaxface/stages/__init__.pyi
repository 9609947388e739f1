from ._common_light import (
    CommonLight,
    LitVertices,
    SharedLight,
    common_light,
    lit_vertices,
    shared_light,
)
from ._unwrap import PartialAlbedo, unwrap
from .blending import (
    Blend,
    blend,
    blended_grams,
    nearest_subject,
    unconstrained,
)
from .fit import (
    FitConfig,
    FitData,
    FitInput,
    FitModel,
    FitRender,
    FitStats,
    FitWeights,
    Posterior,
    WorkingPhoto,
    fit_batch,
    fit_energy,
    fit_parameters,
    posterior,
    prepare,
    render_fit,
    skin_map,
    working_photo,
)
from .fit.self_shadow import with_self_shadow
from .landmarks import (
    DetectedFace,
    NoFaceError,
    SeveralFacesError,
    detect_faces,
    detect_one,
)
from .scan._embed_landmarks import Embedding, embed_landmarks, with_landmarks
from .scan._scan_landmarks import scan_landmarks
from .scan.head_scan import HeadScan
from .scan.register import RegisteredScan, register_topology
from .scan.transfer import (
    TransferredTexture,
    complete_texture,
    resample_texture,
    surface_uv,
    transfer_texture,
    whole_texture,
)
from .texture._plausible_skin import plausible_skin
from .texture._synthesise import (
    Synthesis,
    SynthesisProblem,
    SynthesisWeights,
    synthesis_energy,
    synthesise,
)
from .texture.detail import (
    with_complexion,
    with_intensity,
    with_photo,
    without_marks,
)
from .texture.low_frequency import low_frequency_albedo, over_low_frequency
from .texture.mirror import (
    fill_from_mirror,
    mirror_uv,
    mirrored,
    with_other_side,
)
from .texture.octaves import octave_bands, with_photos_octaves
from .texture.specularity import without_specularity

__all__ = [
    "Blend",
    "CommonLight",
    "DetectedFace",
    "Embedding",
    "FitConfig",
    "FitData",
    "FitInput",
    "FitModel",
    "FitRender",
    "FitStats",
    "FitWeights",
    "HeadScan",
    "LitVertices",
    "NoFaceError",
    "PartialAlbedo",
    "Posterior",
    "RegisteredScan",
    "SeveralFacesError",
    "SharedLight",
    "Synthesis",
    "SynthesisProblem",
    "SynthesisWeights",
    "TransferredTexture",
    "WorkingPhoto",
    "blend",
    "blended_grams",
    "common_light",
    "complete_texture",
    "detect_faces",
    "detect_one",
    "embed_landmarks",
    "fill_from_mirror",
    "fit_batch",
    "fit_energy",
    "fit_parameters",
    "lit_vertices",
    "low_frequency_albedo",
    "mirror_uv",
    "mirrored",
    "nearest_subject",
    "octave_bands",
    "over_low_frequency",
    "plausible_skin",
    "posterior",
    "prepare",
    "register_topology",
    "render_fit",
    "resample_texture",
    "scan_landmarks",
    "shared_light",
    "skin_map",
    "surface_uv",
    "synthesis_energy",
    "synthesise",
    "transfer_texture",
    "unconstrained",
    "unwrap",
    "whole_texture",
    "with_complexion",
    "with_intensity",
    "with_landmarks",
    "with_other_side",
    "with_photo",
    "with_photos_octaves",
    "with_self_shadow",
    "without_marks",
    "without_specularity",
    "working_photo",
]
