"""Photo -> complete intensity as one pure function: a gradient through every step of the way.

`fit` and `complete` stop to look, to tell and to write. This is the same arithmetic without that:
fit and blend are differentiated by the implicit function theorem, the synthesis by unrolling a few
of its steps.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Bool, Float
from jaxface.energies._gram import StyleData, StyleTargets, grams, mask_out, style_energy
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.colour import linear_to_srgb, rgb_to_yiq
from jaxface.models.parameters import FaceParameters
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.stages._unwrap import PartialAlbedo, unwrap
from jaxface.stages.blending import blend_weights
from jaxface.stages.fit import (
    FitConfig,
    FitInput,
    FitModel,
    FitWeights,
    fit_hidden_shading,
    through_levels,
)


class TextureWeights(eqx.Module):
    """What the texture's energies weigh; differentiable."""

    layers: Mapping[str, Float[Array, ""]]
    """factor of each layer in eq. 2"""
    alpha: Float[Array, ""]
    """of eq. 3"""


class TextureProblem(eqx.Module):
    """Everything but the photo and the weights."""

    models: tuple[FitModel, ...]
    """level of detail for each pyramid level of the fit"""
    layout: UVLayout
    network: FeatureNetwork
    database: Float[Array, "k r r"]
    """intensities of the subjects' textures, sRGB-encoded, in the layout"""
    visible: Bool[Array, "r r"]
    """texels that are compared: a choice, held fixed"""


class InferredTexture(NamedTuple):
    """What each arrow of the way gave.

    Attributes:
        parameters: of the fit.
        partial: the albedo that the photo shows.
        weights: of the blend.
        image: complete intensity.
    """

    parameters: FaceParameters
    partial: PartialAlbedo
    weights: Float[Array, "k"]
    image: Float[Array, "r r"]


def infer_texture(
    photo: FitInput,
    fit_weights: FitWeights,
    texture_weights: TextureWeights,
    problem: TextureProblem,
    config: FitConfig,
    *,
    steps: int = 3,
    rate: float = 0.05,
) -> InferredTexture:
    """Fit, unwrap, analyse, blend, and ``steps`` steps of synthesis from the model's own albedo.

    Differentiable in the photo's pixels and landmarks and in all weights, in reverse mode. What is
    chosen is held fixed: visible triangles, inliers, compared texels. The fit's part is true
    where its last level has converged (``gauss_newton``): give it steps and a small ``rtol``. The
    synthesis is truncated: plain descent, each step moving the intensities by ``rate`` at most.

    Args:
        photo: the working image.
        fit_weights: of eq. 1.
        texture_weights: of eqs. 2 and 3.
        problem: models, layout, network, database.
        config: of the fit.
        steps: of the synthesis.
        rate: largest change of an intensity in one step.
    """
    y, _, models = through_levels(photo, problem.models, fit_weights, config)
    model = models[-1].model
    size = photo.image.shape[0]
    partial = unwrap(
        photo.image, jax.lax.stop_gradient(photo.mask),
        y.pose(model.shape(y.identity, y.expression)), model.faces,
        y.camera(photo.principal, size), y.light, problem.layout, fit_hidden_shading(y, model),
        tile=problem.layout.resolution,
    )  # fmt: skip
    layers = tuple(texture_weights.layers)

    def statistics(image: Array) -> dict[str, Array]:
        return grams(image, problem.network, layers=layers, method="direct")

    shown = rgb_to_yiq(linear_to_srgb(partial.albedo))[..., 0]
    target = statistics(mask_out(shown, problem.visible))
    masked = jax.lax.map(
        lambda image: statistics(mask_out(image, problem.visible)), problem.database
    )
    w, _ = blend_weights(masked, target, weights=texture_weights.layers)
    whole = jax.lax.map(statistics, problem.database)
    goal = {name: jnp.einsum("k,kij->ij", w.astype(g.dtype), g) for name, g in whole.items()}
    low = problem.layout(model.reflectance(y.albedo), model.faces)
    start = rgb_to_yiq(linear_to_srgb(jnp.clip(low, 0.0, 1.0)))[..., 0]
    data = StyleData(problem.network, StyleTargets(goal, alpha=texture_weights.alpha))

    def descend(image: Array, _: None) -> tuple[Array, None]:
        slope = jax.grad(style_energy)(image, data, method="direct")
        # alpha alone would cancel in a normalised step; the smooth bound keeps it in.
        return image - rate * slope / (1.0 + jnp.sqrt(jnp.max(slope**2) + 1e-12)), None

    image, _ = jax.lax.scan(descend, start, None, length=steps)
    return InferredTexture(y, partial, w, image)
