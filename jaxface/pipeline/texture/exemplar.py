"""A texture from a picture of it: one file in, one file out."""

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypedDict, Unpack

import numpy as np

from jaxface.io.feature_weights import load_network
from jaxface.io.formats.image import read_image, write_png
from jaxface.stages.texture._synthesise_texture import TextureSynthesis, synthesise_texture


class ExemplarOptions(TypedDict, total=False):
    """Options of `stages.synthesise_texture`; what is left out has its default there."""

    layers: Sequence[str] | None
    alpha: float
    size: int | tuple[int, int] | None
    histogram: float
    octaves: int
    steps: int
    seed: int


def synthesise_file(
    picture: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    features: str | Path = "random",
    on_step: Callable[[int, int], bool | None] | None = None,
    **options: Unpack[ExemplarOptions],
) -> TextureSynthesis:
    """Read an exemplar, synthesise its texture, write it as a PNG, whole or not at all.

    Args:
        picture: any image file, taken as a texture as a whole.
        out: the PNG to write.
        features: network or file of weights, see `io.feature_weights.load_network`.
        on_step: called with the steps done and those of all levels.
        options: of `stages.synthesise_texture`.

    Raises:
        FileNotFoundError: the picture or the weights are not there.
        ValueError: a file is damaged, or as `stages.synthesise_texture` raises.
    """
    exemplar = read_image(picture).pixels
    network = load_network(features)
    made = synthesise_texture(exemplar, network, on_step=on_step, **options)
    write_png(out, np.asarray(made.texture))
    return made


def parse_size(text: str | None) -> int | tuple[int, int] | None:
    """A size as typed: ``512`` for a square, ``512x768`` for height and width.

    Raises:
        ValueError: it is neither.
    """
    if text is None:
        return None
    sides = text.lower().split("x")
    if len(sides) > 2 or not all(side.strip().isdigit() for side in sides):
        raise ValueError(f"size is {text!r}; a side or HEIGHTxWIDTH is needed, as 512 or 512x768")
    return int(sides[0]) if len(sides) == 1 else (int(sides[0]), int(sides[1]))
