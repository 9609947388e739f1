from ._depth_buffer import DepthBuffer, depth_buffer
from ._interpolate import interpolate
from ._rasterize import Fragments, barycentrics, rasterize
from .image import RenderedImage, render, render_textured
from .occlusion import hidden_shading, self_occlusion, sh_rotation
from .shading import (
    ambient_light,
    irradiance,
    light_from_radiance,
    sh_basis,
)

__all__ = [
    "DepthBuffer",
    "Fragments",
    "RenderedImage",
    "ambient_light",
    "barycentrics",
    "depth_buffer",
    "hidden_shading",
    "interpolate",
    "irradiance",
    "light_from_radiance",
    "rasterize",
    "render",
    "render_textured",
    "self_occlusion",
    "sh_basis",
    "sh_rotation",
]
