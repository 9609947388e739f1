"""The face mesh: 468 points of a face in a 192x192 crop, and whether there is one.

Kartynnik et al., "Real-time Facial Surface Geometry from Monocular Video on Mobile GPUs", 2019.
Weights: MediaPipe (Apache-2.0).
"""

from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxface._numerics import safe_arctan2, safe_norm
from jaxface._types import Array, Float, Int
from jaxface.imaging.resample import affine_crop
from jaxface.networks.landmarks.blaze import Convolution, ResidualBlock, chain, read_chain

CROP_SIZE = 192
"""side of the network's input, px"""

REGION_MARGIN = 1.5
"""a region's side over the longer side of the box that it was made from"""

_EYE_CORNERS = (33, 263)


class LandmarkNet(eqx.Module):
    """The network: a trunk, then a branch for the points and one for the presence of a face."""

    trunk: tuple[Convolution | ResidualBlock, ...]
    points: tuple[Convolution | ResidualBlock, ...]
    points_head: Convolution
    presence: tuple[Convolution | ResidualBlock, ...]
    presence_head: Convolution
    mirror: Int[Array, "468"]
    """index of each point's mirror image"""

    def __call__(
        self, crop: Float[Array, "192 192 3"]
    ) -> tuple[Float[Array, "468 3"], Float[Array, ""]]:
        """Points (x, y and relative depth, px of the crop; larger depth is farther) and presence.

        The crop is sRGB-encoded RGB in [0, 1]; presence is a probability.
        """
        features = chain(self.trunk, crop)
        points = _whole_map(self.points_head, chain(self.points, features))
        logit = _whole_map(self.presence_head, chain(self.presence, features))
        return points.reshape(-1, 3), jax.nn.sigmoid(logit[0])


def _whole_map(layer: Convolution, x: Float[Array, "k k i"]) -> Float[Array, "o"]:
    # The last convolution covers the whole 3x3 map, without padding.
    return jnp.einsum("hwi,hwio->o", x, layer.kernel) + layer.bias


def read_landmark_net(arrays: Mapping[str, np.ndarray]) -> LandmarkNet:
    """The network from its named weights (float32).

    Raises:
        ValueError: a part is missing, or a branch does not end in a convolution.
    """
    *points, points_head = read_chain(arrays, "mesh/points", halving=(0,))
    *presence, presence_head = read_chain(arrays, "mesh/presence", halving=(0,))
    if not (isinstance(points_head, Convolution) and isinstance(presence_head, Convolution)):
        raise ValueError("mesh/points and mesh/presence must end in a convolution")
    return LandmarkNet(
        trunk=read_chain(arrays, "mesh/trunk", halving=(0, 3, 6, 9, 12)),
        points=tuple(points),
        points_head=points_head,
        presence=tuple(presence),
        presence_head=presence_head,
        mirror=jnp.asarray(arrays["mesh/mirror"], jnp.int32),
    )


class Region(eqx.Module):
    """A rotated square of an image that holds one face."""

    centre: Float[Array, "2"]
    """x, y px"""
    side: Float[Array, ""]
    """px"""
    angle: Float[Array, ""]
    """of the eye line from the image's x axis towards its y axis (clockwise on screen), radians"""

    def transform(self, size: int = CROP_SIZE) -> Float[Array, "2 3"]:
        """Affine map from the coordinates (px) of a square crop of that size to the image's."""
        scale = self.side / size
        rotation = rotation_2d(self.angle) * scale
        corner = self.centre - rotation @ jnp.full(2, size / 2)
        return jnp.concatenate([rotation, corner[:, None]], axis=1)


def rotation_2d(angle: Float[Array, ""]) -> Float[Array, "2 2"]:
    """Rotation by an angle (radians) from x towards y."""
    cosine, sine = jnp.cos(angle), jnp.sin(angle)
    return jnp.stack([jnp.stack([cosine, -sine]), jnp.stack([sine, cosine])])


def region_from_eyes(
    box: Float[Array, "4"], right_eye: Float[Array, "2"], left_eye: Float[Array, "2"]
) -> Region:
    """Region for a detected box, level with the subject's eyes."""
    across = left_eye - right_eye
    side = REGION_MARGIN * jnp.max(box[2:] - box[:2])
    return Region((box[:2] + box[2:]) / 2, side, safe_arctan2(across[1], across[0]))


def region_from_landmarks(landmarks: Float[Array, "468 3"]) -> Region:
    """Region around known points: square, level with the outer eye corners.

    The box is taken in the rotated frame, so a turned picture gives the same crop.
    """
    points = landmarks[:, :2]
    right, left = (points[i] for i in _EYE_CORNERS)
    across = left - right
    angle = safe_arctan2(across[1], across[0])
    rotation = rotation_2d(angle)
    level = points @ rotation
    low, high = jnp.min(level, axis=0), jnp.max(level, axis=0)
    return Region(rotation @ ((low + high) / 2), REGION_MARGIN * jnp.max(high - low), angle)


def landmarks_in_region(
    net: LandmarkNet, image: Float[Array, "h w 3"], region: Region
) -> tuple[Float[Array, "468 3"], Float[Array, ""]]:
    """Points (px of the image, depth on the same scale) and presence of the face in a region.

    Differentiable with respect to the image (sRGB-encoded, [0, 1]) and to the region.
    """
    points, presence = net(_crop(image, region))
    return _from_crop(points, region), presence


def symmetric_landmarks(
    net: LandmarkNet, image: Float[Array, "h w 3"], region: Region
) -> tuple[Float[Array, "468 3"], Float[Array, ""]]:
    """As ``landmarks_in_region``, the mean over the crop and its mirror image.

    The network is not quite symmetric: the two differ by about 1% of the distance between the
    eyes, and their mean moves a third as much as either when the crop moves a little.
    """
    crop = _crop(image, region)
    points, presence = jax.vmap(net)(jnp.stack([crop, crop[:, ::-1]]))
    unmirrored = points[1][net.mirror] * jnp.array([-1, 1, 1]) + jnp.array([CROP_SIZE, 0, 0])
    return _from_crop((points[0] + unmirrored) / 2, region), jnp.mean(presence)


def _crop(image: Float[Array, "h w 3"], region: Region) -> Float[Array, "192 192 3"]:
    return affine_crop(image, region.transform(), CROP_SIZE, CROP_SIZE)


def _from_crop(points: Float[Array, "468 3"], region: Region) -> Float[Array, "468 3"]:
    transform = region.transform()
    flat = points[:, :2] @ transform[:, :2].T + transform[:, 2]
    depth = points[:, 2:] * (region.side / CROP_SIZE)
    return jnp.concatenate([flat, depth], axis=1)


def refine_landmarks(
    net: LandmarkNet, image: Float[Array, "h w 3"], region: Region, passes: int = 2
) -> tuple[Float[Array, "468 3"], Float[Array, ""]]:
    """Points and presence after some rounds, each in the region that the last one's points give.

    Raises:
        ValueError: ``passes`` is less than 1.
    """
    if passes < 1:
        raise ValueError(f"passes is {passes}; at least one is needed")
    for _ in range(passes - 1):
        region = region_from_landmarks(landmarks_in_region(net, image, region)[0])
    return landmarks_in_region(net, image, region)


def inter_ocular_distance(landmarks: Float[Array, "468 3"]) -> Float[Array, ""]:
    """Distance between the outer eye corners in the image, px."""
    right, left = (landmarks[i, :2] for i in _EYE_CORNERS)
    return safe_norm(left - right)
