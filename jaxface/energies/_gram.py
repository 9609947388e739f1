"""Feature correlations of a texture, and the energies of matching them (Saito 2017, secs. 4-5).

G^l(I) = F^l(I) F^l(I)^T / M_l                                        (Gramian, section 4)
E(I) = sum_l ||F^l(I) - F^l_hat||_F^2 + alpha sum_l ||G^l(I) - G^l_hat||_F^2          (eq. 3)
"""

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp

from jaxface._types import Array, Bool, Float
from jaxface.networks.texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    features,
    layer_position,
)
from jaxface.networks.texture_features.tiles import sum_over_tiles, tile_of_map

MASKED = 0.5
"""intensity of what is not visible (Saito 2017, section 4)"""

DETAIL_WEIGHT = 2000.0
"""alpha of eq. 3"""


@jax.custom_jvp
def gram(responses: Float[Array, "h w n"]) -> Float[Array, "n n"]:
    """Normalised Gramian ``F F^T / M`` of a layer's responses, M the number of pixels."""
    pixels = responses.reshape(-1, responses.shape[-1])
    return pixels.T @ pixels / pixels.shape[0]


@gram.defjvp
def _gram_jvp(
    primals: tuple[Array], tangents: tuple[Array]
) -> tuple[Float[Array, "n n"], Float[Array, "n n"]]:
    # One product instead of two, in both modes: dG = X + X^T with X = F dF^T / M.
    (responses,), (change,) = primals, tangents
    pixels = responses.reshape(-1, responses.shape[-1])
    half = pixels.T @ change.reshape(pixels.shape) / pixels.shape[0]
    return gram(responses), half + half.T


def mask_out(image: Float[Array, "h w"], visible: Bool[Array, "h w"]) -> Float[Array, "h w"]:
    """The mask-out function M(I) of section 4: 0.5 where a pixel is not visible."""
    return jnp.where(visible, image, jnp.asarray(MASKED, image.dtype))


def grams(
    image: Float[Array, "h w"],
    network: FeatureNetwork,
    *,
    layers: Sequence[str] = STYLE_LAYERS,
    tile: int | None = None,
    method: str = "auto",
) -> dict[str, Float[Array, "_ _"]]:
    """Gramians G^l(I) of an image.

    Differentiable in both modes with and without tiles.

    Args:
        image: Y of the gamma-encoded texture in [0, 1], already masked out where that is wanted.
        network: the weights.
        layers: names.
        tile: where given and smaller than the image, it is processed in squares of this side (px,
            a multiple of 16 for layers of block 5) in memory that the tile bounds, with the same
            result; a gradient then visits each tile twice.
        method: how convolutions are computed, see ``conv3x3.METHODS``.

    Raises:
        ValueError: a layer is unknown or empty, the image is not (h, w), the tile does not fit.
    """
    return _statistics(image, network, tuple(layers), {}, tile, method)[0]


class StyleTargets(eqx.Module):
    """What a texture is to match: the hatted quantities of eq. 3, with weights."""

    grams: Mapping[str, Float[Array, "_ _"]]
    """by layer of L_G, (n, n) with the n of each"""
    features: Mapping[str, Float[Array, "_ _ _"]] = eqx.field(default_factory=dict)
    """by layer of L_F, (h, w, n) with those of each"""
    alpha: Float[Array, ""] | float = DETAIL_WEIGHT
    gram_weights: Mapping[str, Float[Array, ""] | float] = eqx.field(default_factory=dict)
    """by layer; 1 where none is given, as in the paper"""
    feature_weights: Mapping[str, Float[Array, ""] | float] = eqx.field(default_factory=dict)


class StyleData(eqx.Module):
    """Arguments of the style energy."""

    network: FeatureNetwork
    targets: StyleTargets


def gram_loss(
    grams: Mapping[str, Float[Array, "_ _"]],
    targets: Mapping[str, Float[Array, "_ _"]],
    weights: Mapping[str, Float[Array, ""] | float] | None = None,
) -> Float[Array, ""]:
    """``sum_l w_l ||G^l - G^l_hat||_F^2`` over the layers of ``targets``; weights default to 1.

    Raises:
        ValueError: a target's layer is not among ``grams``, or its shape differs.
    """
    return _weighted_distance(grams, targets, weights or {}, "Gram")


def feature_loss(
    features: Mapping[str, Float[Array, "_ _ _"]],
    targets: Mapping[str, Float[Array, "_ _ _"]],
    weights: Mapping[str, Float[Array, ""] | float] | None = None,
) -> Float[Array, ""]:
    """``sum_l w_l ||F^l - F^l_hat||_F^2`` over the layers of ``targets``; weights default to 1.

    Raises:
        ValueError: a target's layer is not among ``features``, or its shape differs.
    """
    return _weighted_distance(features, targets, weights or {}, "feature")


def _weighted_distance(
    values: Mapping[str, Array],
    targets: Mapping[str, Array],
    weights: Mapping[str, Array | float],
    kind: str,
) -> Float[Array, ""]:
    total = jnp.zeros(())
    for name, target in targets.items():
        if name not in values:
            raise ValueError(f"a {kind} target is given for {name}; there are {sorted(values)}")
        if values[name].shape != target.shape:
            raise ValueError(
                f"{kind} target of {name} has shape {target.shape}; needed is {values[name].shape}"
            )
        total = total + weights.get(name, 1.0) * jnp.sum((values[name] - target) ** 2)
    return total


def style_energy(
    image: Float[Array, "h w"], data: StyleData, *, tile: int | None = None, method: str = "auto"
) -> Float[Array, ""]:
    """The energy of texture synthesis, eq. 3 of Saito 2017.

    Differentiable in both modes with respect to the image, the network, the targets and the
    weights, with and without tiles (see ``grams``).

    Args:
        image: Y of the gamma-encoded texture in [0, 1].
        data: the network, and what its responses are to match.
        tile: see ``grams``.
        method: see ``grams``.

    Raises:
        ValueError: as ``grams`` does, or a target's shape does not fit.
    """
    targets = data.targets
    found, distances = _statistics(
        image, data.network, tuple(targets.grams), targets.features, tile, method
    )
    total = targets.alpha * gram_loss(found, targets.grams, targets.gram_weights)
    for name, distance in distances.items():
        total = total + targets.feature_weights.get(name, 1.0) * distance
    return total


def style_value_and_grad(
    image: Float[Array, "h w"], data: StyleData, *, tile: int | None = None, method: str = "auto"
) -> tuple[Float[Array, ""], Float[Array, "h w"]]:
    """``style_energy`` and its gradient with respect to the image."""
    return jax.value_and_grad(style_energy)(image, data, tile=tile, method=method)


def _statistics(
    image: Float[Array, "h w"],
    network: FeatureNetwork,
    gram_layers: tuple[str, ...],
    feature_targets: Mapping[str, Float[Array, "_ _ _"]],
    tile: int | None,
    method: str,
) -> tuple[dict[str, Float[Array, "_ _"]], dict[str, Float[Array, ""]]]:
    """Gramians, and squared distances of the responses from their targets, by layer."""
    layers = tuple(dict.fromkeys((*gram_layers, *feature_targets)))
    if tile is None or max(image.shape) <= tile:
        found = features(network, image, layers, method)
        distances = {
            name: feature_loss(found, {name: target}) for name, target in feature_targets.items()
        }
        return {name: gram(found[name]) for name in gram_layers}, distances

    def of_tile(found: dict[str, Array], place: Array) -> tuple[dict[str, Array], dict[str, Array]]:
        distances = {
            name: jnp.sum((found[name] - tile_of_map(target, name, place, tile)) ** 2)
            for name, target in feature_targets.items()
        }
        return {name: gram(found[name]) for name in gram_layers}, distances

    for name, target in feature_targets.items():
        expected = (*_map_shape(image, name), network.channels[name])
        if target.shape != expected:
            raise ValueError(
                f"feature target of {name} has shape {target.shape}; needed is {expected}"
            )
    sums, distances = sum_over_tiles(of_tile, network, image, layers, tile, method)
    scale = {}
    for name in gram_layers:
        height, width = _map_shape(image, name)
        side = tile >> (layer_position(name)[0] - 1)
        scale[name] = side**2 / (height * width)
    return {name: sums[name] * scale[name] for name in gram_layers}, distances


def _map_shape(image: Float[Array, "h w"], layer: str) -> tuple[int, int]:
    block = layer_position(layer)[0] - 1
    return image.shape[0] >> block, image.shape[1] >> block
