"""Procedural human skin: albedo textures made of pigments, pores, furrows, hairs and spots."""

from jaxface.models.skin.attributes import SkinAttributes, random_attributes
from jaxface.models.skin.synthesis import synthesise_skin

__all__ = ["SkinAttributes", "random_attributes", "synthesise_skin"]
