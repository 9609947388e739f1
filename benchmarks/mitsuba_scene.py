"""A head rendered by mitsuba, an independent physically based renderer.

Everything is handed over in the camera's frame (mm; x right, y up, the camera at the origin
looking along -z), so mitsuba's own view transform and not ours decides where a vertex lands.
"""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Surface:
    """A triangle mesh with per-vertex linear RGB reflectance."""

    vertices: np.ndarray
    faces: np.ndarray
    albedo: np.ndarray
    roughness: float | None = None
    """None: Lambertian. Else the roughness of a dielectric gloss over a diffuse base."""


def load_mitsuba(variant: str):
    """The mitsuba module with a variant selected.

    Raises:
        ImportError: mitsuba is not installed.
        ValueError: it is, but has no such variant.
    """
    try:
        import mitsuba as mi
    except ImportError as error:
        raise ImportError(
            "the ground-truth renders need mitsuba: pip install 'jaxface[bench]'"
        ) from error
    if variant not in mi.variants():
        raise ValueError(f"mitsuba has no variant {variant!r}; it has {mi.variants()}")
    mi.set_variant(variant)
    return mi


def _bsdf(mi, surface: Surface):
    colour = {"type": "mesh_attribute", "name": "vertex_color"}
    if surface.roughness is None:
        inner = {"type": "diffuse", "reflectance": colour}
    else:
        inner = {
            "type": "principled",
            "base_color": colour,
            "roughness": surface.roughness,
            "specular": 0.4,
        }
    return mi.load_dict({"type": "twosided", "material": inner})


def _mesh(mi, name: str, surface: Surface, bsdf, emitter=None):
    props = mi.Properties()
    props["bsdf"] = bsdf
    if emitter is not None:
        props["emitter"] = emitter
    mesh = mi.Mesh(
        name, len(surface.vertices), len(surface.faces), props=props, has_vertex_normals=True
    )
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.ravel(surface.vertices).astype(np.float32)
    parameters["faces"] = np.ravel(surface.faces).astype(np.uint32)
    parameters.update()
    mesh.recompute_vertex_normals()
    mesh.add_attribute("vertex_color", 3, np.ravel(surface.albedo).astype(np.float32))
    return mesh


def _sensor(mi, fov: float, size: int, samples: int, seed: int) -> dict:
    transform = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, -1], up=[0, 1, 0])
    return {
        "type": "perspective",
        "fov": fov,
        "fov_axis": "larger",
        "to_world": transform,
        "near_clip": 10.0,
        "far_clip": 20000.0,
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "pixel_format": "rgba",
            "rfilter": {"type": "box"},
        },
        "sampler": {"type": "multijitter", "sample_count": samples, "seed": seed},
    }


def render(
    mi,
    surfaces: list[Surface],
    radiance: np.ndarray,
    fov: float,
    size: int,
    samples: int = 64,
    depth: int = 3,
    seed: int = 0,
) -> np.ndarray:
    """Linear RGBA image (size, size, 4) under a distant light, shadows and bounces included.

    ``fov`` is the full angle along the longer side in degrees, ``depth`` the longest path
    (2: direct light with cast shadows; 3 or more: light that bounced between parts of the face).
    Alpha is coverage; colour is premultiplied.
    """
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": depth, "hide_emitters": True},
        "sensor": _sensor(mi, fov, size, samples, seed),
        "light": {"type": "envmap", "bitmap": mi.Bitmap(radiance.astype(np.float32))},
    }
    for index, surface in enumerate(surfaces):
        scene[f"mesh{index}"] = _mesh(mi, f"mesh{index}", surface, _bsdf(mi, surface))
    return np.array(mi.render(mi.load_dict(scene), spp=samples, seed=seed))


def render_unshadowed(
    mi,
    surfaces: list[Surface],
    shading: list[np.ndarray],
    fov: float,
    size: int,
    samples: int = 32,
    seed: int = 0,
) -> np.ndarray:
    """Linear RGBA image of ``albedo * shading`` per vertex: a light that nothing blocks.

    ``shading`` is irradiance over pi, one (n, 3) array per surface. The product is handed over as
    radiance that the surface itself emits, so that only mitsuba's projection, visibility and
    interpolation are at work: the image model of a fit by spherical harmonics, without its shadows'
    model error.
    """
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 1},
        "sensor": _sensor(mi, fov, size, samples, seed),
    }
    black = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}})
    for index, (surface, light) in enumerate(zip(surfaces, shading, strict=True)):
        glow = Surface(surface.vertices, surface.faces, surface.albedo * light)
        emitter = mi.load_dict(
            {"type": "area", "radiance": {"type": "mesh_attribute", "name": "vertex_color"}}
        )
        scene[f"mesh{index}"] = _mesh(mi, f"mesh{index}", glow, black, emitter)
    return np.array(mi.render(mi.load_dict(scene), spp=samples, seed=seed))
