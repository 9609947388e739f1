"""A generic skin for models that store no albedo.

A fit needs an albedo that can become darker, lighter and redder. The mean is a light-brown skin;
the modes are the two pigments that colour skin, and the places where every face differs from its
cheek: lips, brows and the beard.
"""

import numpy as np

from jaxface._types import Float, Int

MEAN_SKIN = np.array([0.46, 0.27, 0.19])
"""linear RGB of the mean cheek: the middle of the published range of skin reflectance"""

_WAVELENGTHS = np.array([610.0, 550.0, 465.0])  # nm, centres of the sRGB primaries' bands
# Melanin absorbs as wavelength^-3.33 (Jacques, "Skin optics", 1998).
MELANIN = (_WAVELENGTHS / _WAVELENGTHS[1]) ** -3.33
# Oxyhaemoglobin's molar extinction at those wavelengths relative to green (Prahl's tables).
HAEMOGLOBIN = np.array([0.03, 1.0, 0.75])

MELANIN_STD = 0.24
"""optical density of one standard deviation in green: 2 of them halve it, fair to dark skin"""
HAEMOGLOBIN_STD = 0.08


def generic_skin(
    vertices: Float[np.ndarray, "n 3"], landmarks68: Float[np.ndarray, "68 3"] | None = None
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 k"], Float[np.ndarray, "k"]]:
    """Mean albedo, basis (one standard deviation a column) and standard deviations (ones).

    Two pigment modes over the whole head, linearised at the mean by Beer and Lambert:
    ``d albedo = -albedo * density * std``. With the 68 landmarks also the redness of the lips,
    the darkness of the brows and that of the beard, each a smooth window around its landmarks,
    and a mean whose lips and brows already differ from the cheek.

    Args:
        vertices: mean shape (mm).
        landmarks68: positions of the 68 points on it (mm), if known.
    """
    count = len(vertices)
    mean = np.tile(MEAN_SKIN, (count, 1))
    densities = [MELANIN_STD * np.tile(MELANIN, (count, 1))]
    densities.append(HAEMOGLOBIN_STD * np.tile(HAEMOGLOBIN, (count, 1)))
    if landmarks68 is not None:
        eyes = float(np.linalg.norm(landmarks68[36] - landmarks68[45]))
        lips = _window(vertices, landmarks68[48:60], 0.055 * eyes)
        right, left = (_window(vertices, landmarks68[a : a + 5], 0.05 * eyes) for a in (17, 22))
        brows = np.maximum(right, left)
        jaw = np.concatenate([landmarks68[3:14], landmarks68[48:60], landmarks68[31:36]])
        below = 1 / (1 + np.exp((vertices[:, 1] - landmarks68[33, 1]) / (0.06 * eyes)))
        beard = _window(vertices, jaw, 0.25 * eyes) * below * (1 - lips)
        mean *= np.exp(-0.35 * lips[:, None] * HAEMOGLOBIN - 0.6 * brows[:, None])
        densities += [
            0.2 * lips[:, None] * HAEMOGLOBIN,
            0.3 * brows[:, None] * np.ones(3),
            0.12 * beard[:, None] * np.ones(3),
        ]
    basis = np.stack([-mean * density for density in densities], axis=-1)
    return mean, basis, np.ones(basis.shape[-1])


def _window(vertices: np.ndarray, points: np.ndarray, width: float) -> np.ndarray:
    """One at the points, falling to zero as a Gaussian of their distance (mm)."""
    nearest = np.full(len(vertices), np.inf)
    # Segments between consecutive points too, so that sparse landmarks leave no gaps.
    for point in np.concatenate([points, 0.5 * (points[1:] + points[:-1])]):
        nearest = np.minimum(nearest, np.sum((vertices - point) ** 2, axis=1))
    return np.exp(-0.5 * nearest / width**2)


_TEETH = np.array([0.58, 0.52, 0.42])
_GUMS = np.array([0.35, 0.13, 0.12])
_EYE_WHITE = np.array([0.60, 0.56, 0.52])
_IRIS = np.array([0.07, 0.04, 0.025])
_IRIS_RADIUS = 6.0  # mm, half the visible iris diameter of an adult


def paint_parts(
    vertices: Float[np.ndarray, "n 3"],
    region: Int[np.ndarray, "n"],
    region_names: tuple[str, ...],
    mean: Float[np.ndarray, "n 3"],
    basis: Float[np.ndarray, "n 3 k"],
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3 k"]]:
    """Give teeth, gums and eyeballs colours of their own, which no skin mode changes.

    An eyeball's iris is the disc around its foremost vertex (mm). Regions other than "teeth",
    "gums" and those that end in "_eye" are left as they are.

    Returns:
        The mean and basis of `generic_skin` with those vertices replaced.
    """
    mean, basis = mean.copy(), basis.copy()
    for index, name in enumerate(region_names):
        inside = np.flatnonzero(region == index)
        if name == "teeth":
            mean[inside] = _TEETH
        elif name == "gums":
            mean[inside] = _GUMS
        elif name.endswith("_eye") and len(inside):
            ball = vertices[inside]
            front = ball[np.argmax(ball[:, 2])]
            iris = np.linalg.norm(ball - front, axis=1) < _IRIS_RADIUS
            mean[inside] = np.where(iris[:, None], _IRIS, _EYE_WHITE)
        else:
            continue
        basis[inside] = 0.0
    return mean, basis
