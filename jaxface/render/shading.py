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
    x, y, z = normals[..., 0], normals[..., 1], normals[..., 2]
    return jnp.stack(
        [
            jnp.full_like(x, Y0),
            Y1 * y,
            Y1 * z,
            Y1 * x,
            Y2 * x * y,
            Y2 * y * z,
            Y20 * (3.0 * z * z - 1.0),
            Y2 * x * z,
            Y22 * (x * x - y * y),
        ],
        axis=-1,
    )


@jax.custom_jvp
def irradiance(
    normals: Float[Array, "*batch 3"], light: Float[Array, "9 3"]
) -> Float[Array, "*batch 3"]:
    """Shading ``H(n) L``, linear RGB, by which the albedo is multiplied (Saito 2017, section 3).

    ``L`` holds the coefficients of the shading itself, with the cosine lobe already in it; see
    ``light_from_radiance``. The value may be negative where the second order rings.
    """
    return sh_basis(normals) @ light


@irradiance.defjvp
def _irradiance_jvp(
    primals: tuple[Array, Array], tangents: tuple[Array, Array]
) -> tuple[Array, Array]:
    # As one form of the light, since the columns of `sh_basis` would each be differentiated, and
    # compiled, on their own.
    (normals, light), (turned, changed) = primals, tangents
    basis = sh_basis(normals)
    slope = irradiance_slope(normals, light)
    change = jnp.einsum("...cx,...x->...c", slope, turned, precision="highest")
    return basis @ light, change + basis @ changed


def irradiance_slope(
    normals: Float[Array, "*batch 3"], light: Float[Array, "9 3"]
) -> Float[Array, "*batch 3 3"]:
    """Derivative of ``irradiance`` (colour, last but one axis) along x, y and z (last axis).

    Twice ``M_c (n, 1)``, since irradiance is the quadratic form ``(n, 1)^T M_c (n, 1)`` of each
    colour (Ramamoorthi & Hanrahan 2001, equations 11 and 12).
    """
    forms = jnp.asarray(_FORMS, light.dtype)
    matrices = 2.0 * jnp.einsum("kc,kij->cij", light, forms, precision="highest")
    turned = jnp.einsum("...i,cij->...cj", normals, matrices[:, :3, :3], precision="highest")
    return turned + matrices[:, 3, :3]


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
