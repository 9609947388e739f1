"""Diffuse shading by second-order spherical harmonics: 27 light coefficients.

Real spherical harmonics and their order follow Ramamoorthi & Hanrahan, "An efficient
representation for irradiance environment maps", SIGGRAPH 2001, equation 3. For a unit normal
(x, y, z) the nine functions are, in this order (band l, order m):

    (0,  0) 0.282095
    (1, -1) 0.488603 y      (1, 0) 0.488603 z              (1, 1) 0.488603 x
    (2, -2) 1.092548 x y    (2, -1) 1.092548 y z           (2, 0) 0.315392 (3 z^2 - 1)
    (2,  1) 1.092548 x z    (2, 2) 0.546274 (x^2 - y^2)

Light is given in the camera's frame (x right, y up, z towards the camera).
"""

import math

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Float

Y0 = math.sqrt(1 / (4 * math.pi))
Y1 = math.sqrt(3 / (4 * math.pi))
Y2 = math.sqrt(15 / (4 * math.pi))
Y20 = math.sqrt(5 / (16 * math.pi))
Y22 = math.sqrt(15 / (16 * math.pi))

BAND = (0, 1, 1, 1, 2, 2, 2, 2, 2)
"""band l of each of the nine functions"""


def _quadratic_forms() -> Float[np.ndarray, "9 4 4"]:
    """Symmetric ``Q_k`` with ``H_k(n) = (n, 1)^T Q_k (n, 1)``."""
    terms: tuple[dict[str, float], ...] = (
        {"11": Y0}, {"y1": Y1}, {"z1": Y1}, {"x1": Y1}, {"xy": Y2}, {"yz": Y2},
        {"zz": 3 * Y20, "11": -Y20}, {"xz": Y2}, {"xx": Y22, "yy": -Y22},
    )  # fmt: skip
    forms = np.zeros((9, 4, 4))
    for form, products in zip(forms, terms, strict=True):
        for product, factor in products.items():
            i, j = ("xyz1".index(letter) for letter in product)
            form[i, j] += factor / 2
            form[j, i] += factor / 2
    return forms


_FORMS = _quadratic_forms()


def sh_basis(normals: Float[Array, "*batch 3"]) -> Float[Array, "*batch 9"]:
    """The nine functions H(n) at unit normals, order and constants as stated above."""
    # As products of matrices: nine columns put side by side would each be compiled on their own.
    forms = jnp.asarray(_FORMS, normals.dtype)
    return _forms_at(normals, forms)


def sh_basis_on_host(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 9"]:
    """``sh_basis`` in NumPy and double precision, for tables that are made while tracing."""
    points = np.concatenate([normals, np.ones((len(normals), 1))], axis=1)
    return np.einsum("ni,kij,nj->nk", points, _FORMS, points)


def _forms_at(
    normals: Float[Array, "*batch 3"], forms: Float[Array, "k 4 4"]
) -> Float[Array, "*batch k"]:
    """Quadratic forms ``(n, 1)^T Q_k (n, 1)``."""
    squares = (normals[..., :, None] * normals[..., None, :]).reshape(*normals.shape[:-1], 9)
    square = forms[:, :3, :3].reshape(-1, 9).T
    linear, constant = 2.0 * forms[:, :3, 3].T, forms[:, 3, 3]
    by_squares = jnp.matmul(squares, square, precision="highest")
    return by_squares + jnp.matmul(normals, linear, precision="highest") + constant


@jax.custom_jvp
def irradiance(
    normals: Float[Array, "*batch 3"], light: Float[Array, "9 3"]
) -> Float[Array, "*batch 3"]:
    """Shading ``H(n) L``, linear RGB, by which the albedo is multiplied (Saito 2017, section 3).

    ``L`` holds the coefficients of the shading itself, with the cosine lobe already in it; see
    ``light_from_radiance``. The value may be negative where the second order rings.
    """
    return _forms_at(normals, _light_forms(light))


@irradiance.defjvp
def _irradiance_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    (normals, light), (turned, changed) = primals, tangents
    slope = irradiance_slope(normals, light)
    change = jnp.einsum("...cx,...x->...c", slope, turned, precision="highest")
    return irradiance(normals, light), change + irradiance(normals, changed)


def irradiance_slope(
    normals: Float[Array, "*batch 3"], light: Float[Array, "9 3"]
) -> Float[Array, "*batch 3 3"]:
    """Derivative of ``irradiance`` (colour, last but one axis) along x, y and z (last axis).

    Twice ``M_c (n, 1)``, since irradiance is the quadratic form ``(n, 1)^T M_c (n, 1)`` of each
    colour (Ramamoorthi & Hanrahan 2001, equations 11 and 12).
    """
    matrices = 2.0 * _light_forms(light)
    turned = jnp.einsum("...i,cij->...cj", normals, matrices[:, :3, :3], precision="highest")
    return turned + matrices[:, 3, :3]


def _light_forms(light: Float[Array, "9 3"]) -> Float[Array, "3 4 4"]:
    """``M_c``: each colour's irradiance as a quadratic form of (n, 1)."""
    return jnp.einsum("kc,kij->cij", light, jnp.asarray(_FORMS, light.dtype), precision="highest")


def light_from_radiance(radiance: Float[Array, "9 3"]) -> Float[Array, "9 3"]:
    """Coefficients of the shading from those of the incoming radiance.

    Multiplies band l by ``A_l / pi`` = (1, 2/3, 1/4), the clamped cosine's coefficients
    (Ramamoorthi & Hanrahan 2001, equation 8) over the Lambertian BRDF's pi.
    """
    lobe = jnp.array([(1.0, 2.0 / 3.0, 0.25)[band] for band in BAND], radiance.dtype)
    return lobe[:, None] * radiance


def ambient_light(intensity: float = 1.0) -> Float[Array, "9 3"]:
    """Light that shades every normal by ``intensity``."""
    return jnp.zeros((9, 3)).at[0].set(intensity / Y0)
