"""Masked Gram matrices of many textures from what is cached of them."""

from jaxface.stages.texture.masked_grams.cells import Layout, Stored, compressed, layout, store
from jaxface.stages.texture.masked_grams.splice import Prepared, masked_grams_of, prepare

__all__ = [
    "Layout",
    "Prepared",
    "Stored",
    "compressed",
    "layout",
    "masked_grams_of",
    "prepare",
    "store",
]
