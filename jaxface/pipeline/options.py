"""What is made of a photo: the settings of the whole journey."""

import os
from dataclasses import dataclass, field
from typing import TypedDict

from jaxface.models.morphable import MorphableModel
from jaxface.pipeline.databases.usual import PAINTED_MODEL
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.stages.fit.options import FitOptions

Path = str | os.PathLike[str]


class DigitizeOverrides(TypedDict, total=False):
    """The fields of `DigitizeOptions` as keywords, for functions that pass them on."""

    model: Path | MorphableModel
    fit: FitOptions
    landmarks: Path | None
    mask: Path | None
    with_texture: bool
    resolution: int
    complete: bool
    completion: CompletionOptions
    database: Path | None
    features: str


@dataclass(frozen=True)
class DigitizeOptions:
    """Settings of `digitize`. Another value for one of them: ``dataclasses.replace``.

    Raises:
        TypeError: a name that is none of the fields.
    """

    model: Path | MorphableModel = field(
        default=PAINTED_MODEL,
        metadata={"help": "Bundled name or model file (.npz .mat .h5 .pkl .bin, folder)."},
    )
    fit: FitOptions = field(default_factory=FitOptions)
    """how the photo is fitted"""
    landmarks: Path | None = field(
        default=None,
        metadata={"help": "Points to use instead of detection: .json, .pts or .txt."},
    )
    mask: Path | None = field(
        default=None, metadata={"help": "Image of the photo's size, white on face skin."}
    )
    with_texture: bool = True
    """whether the albedo is taken from the photo"""
    resolution: int = field(default=2048, metadata={"help": "Texels along a texture's side."})
    complete: bool = field(
        default=True, metadata={"help": "Complete the albedo where the photo does not show it."}
    )
    """only with ``with_texture``"""
    completion: CompletionOptions = field(default_factory=CompletionOptions)
    """how the albedo is completed"""
    database: Path | None = field(
        default=None,
        metadata={
            "help": "Texture database, a folder or a name of `database list`; else the procedural "
            "skins."
        },
    )
    features: str = field(
        default="random", metadata={"help": "random, trained, vgg16, vgg19, or a file of weights."}
    )
    """the feature network, see `load_network`"""

    @classmethod
    def as_published(cls) -> "DigitizeOptions":
        """Saito 2017 as printed, in the fit and in the completion."""
        return cls(fit=FitOptions.as_published(), completion=CompletionOptions.as_published())
