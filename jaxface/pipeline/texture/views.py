"""A fitted face with its complete albedo, seen from several sides in a studio's light."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float, Int
from jaxface.geometry.camera import Camera, Pose
from jaxface.geometry.rotation import rotation_matrix
from jaxface.imaging.mipmap import Mipmap, mipmap
from jaxface.io.formats.exr import srgb_encoded
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.render.image import render_textured
from jaxface.render.occlusion import self_occlusion
from jaxface.render.shading import ambient_light, light_from_radiance, sh_basis_on_host

SIDE = 640
SAMPLES = 2
"""along a pixel's side"""

FIELD = 24.0
"""degrees that the whole head takes; the close-up takes half of them"""

VIEWS = {"from its right": 40.0, "front": 0.0, "from its left": -40.0}
"""degrees about the upright axis"""

BACKGROUND = 0.05

# Direction in the camera's frame and linear RGB: a warm key light and a cool one from the side.
_LAMPS = (((-0.45, 0.45, 0.8), (2.6, 2.52, 2.39)), ((0.9, 0.1, 0.5), (1.08, 1.14, 1.2)))
_AMBIENT = 0.35


def studio_light() -> Float[Array, "9 3"]:
    """Shading of two distant lamps and an even surrounding, in the camera's frame."""
    directions = np.array([lamp[0] for lamp in _LAMPS])
    directions = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    radiance = np.einsum("lk,lc->kc", sh_basis_on_host(directions), [lamp[1] for lamp in _LAMPS])
    return light_from_radiance(jnp.asarray(radiance, jnp.float32)) + ambient_light(_AMBIENT)


def face_views(
    model: MorphableModel, y: FaceParameters, albedo: Float[np.ndarray, "r r 3"]
) -> list[tuple[str, Float[np.ndarray, "s s 3"]]]:
    """Pictures with their titles, sRGB-encoded: three sides of the whole, and the face close.

    Args:
        model: with texture coordinates.
        y: identity and expression of the face; pose and light are the views' own, and the
            close-up has no expression.
        albedo: texture, linear RGB.
    """
    texture = mipmap(jnp.asarray(albedo))
    identity, expression = jnp.asarray(y.identity), jnp.asarray(y.expression)
    scene = _scene(model, identity, expression, texture)
    middle = 0.5 * (scene.low + scene.high)
    pictures = [(title, _view(scene, middle, yaw, FIELD)) for title, yaw in VIEWS.items()]
    rest = _scene(model, identity, jnp.zeros_like(expression), texture)
    names = [n for n in ("eyelids", "nose", "lips", "chin") if n in model.region_names]
    face = np.asarray(rest.vertices)
    if names:
        face = face[np.asarray(model.region_mask(*names))]
    aim = 0.5 * (face.min(axis=0) + face.max(axis=0))
    return [*pictures, ("no expression", _view(rest, aim, 0.0, FIELD / 2))]


class _Scene(eqx.Module):
    """A mesh in its own frame, with what does not depend on the view."""

    vertices: Float[Array, "n 3"]
    occlusion: Float[Array, "n 9"]
    faces: Int[Array, "f 3"]
    uv: Float[Array, "m 2"]
    uv_faces: Int[Array, "f 3"]
    texture: Mipmap

    @property
    def low(self) -> np.ndarray:
        return np.asarray(self.vertices.min(axis=0))

    @property
    def high(self) -> np.ndarray:
        return np.asarray(self.vertices.max(axis=0))


def _scene(model: MorphableModel, identity: Array, expression: Array, texture: Mipmap) -> _Scene:
    vertices, faces = model.shape(identity, expression), jnp.asarray(model.faces)
    uv, uv_faces = jnp.asarray(model.uv), jnp.asarray(model.uv_faces)
    return _Scene(vertices, self_occlusion(vertices, faces), faces, uv, uv_faces, texture)


def _view(
    scene: _Scene, aim: Float[np.ndarray, "3"], yaw: float, field: float
) -> Float[np.ndarray, "s s 3"]:
    """One picture; the distance is that from which the whole mesh nearly fills ``FIELD``."""
    distance = 0.55 * np.max(scene.high - scene.low) / np.tan(np.deg2rad(FIELD) / 2)
    rotation = jnp.array([0.0, np.deg2rad(yaw), 0.0], scene.vertices.dtype)
    turned = np.asarray(rotation_matrix(rotation)) @ aim
    pose = Pose(rotation, jnp.asarray([0.0, 0.0, -distance] - turned, scene.vertices.dtype))
    camera = Camera.from_field_of_view(field, SIDE * SAMPLES, SIDE * SAMPLES)
    return srgb_encoded(np.clip(np.asarray(_draw(scene, pose, camera)), 0, 1))


@jax.jit
def _draw(scene: _Scene, pose: Pose, camera: Camera) -> Float[Array, "s s 3"]:
    side = SIDE * SAMPLES
    drawn = render_textured(
        scene.vertices, scene.faces, scene.texture, scene.uv, scene.uv_faces, pose, camera,
        studio_light(), side, side, BACKGROUND, occlusion=scene.occlusion, cull=True,
    )  # fmt: skip
    return drawn.color.reshape(SIDE, SAMPLES, SIDE, SAMPLES, 3).mean(axis=(1, 3))
