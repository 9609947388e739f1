"""Small inputs of the walk over every differentiable function: records, a scene, a screen."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxface import energies
from jaxface.energies.exemplar import ExemplarTargets, ExemplarWeights, exemplar_targets
from jaxface.geometry.camera import Pose
from jaxface.geometry.normal_stencil import NormalStencil, normal_stencil
from jaxface.geometry.uv import UVLayout
from jaxface.imaging.colour_axes import colour_axes
from jaxface.imaging.mipmap import Mipmap, mipmap
from jaxface.models.morphable import MorphableModel
from jaxface.models.parameters import FaceParameters
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.networks.texture_features.random_weights import random_network
from jaxface.stages.fit.prepared import FitModel
from jaxface.stages.fit.records import FitData, FitInput, FitWeights
from tests.small_scene import small_model, small_parameters

SIDE = 12
"""px of a rendered picture"""


@functools.cache
def model() -> MorphableModel:
    """A bump of 5 x 5 vertices with four modes of each kind and self-occlusion."""
    made = small_model(5)
    rng = np.random.default_rng(7)
    four = dataclasses.replace(made.albedo, basis=40 * made.albedo.basis)
    return dataclasses.replace(
        made,
        identity=made.identity.truncated(4),
        expression=four,
        expression_names=tuple("abcd"),
        occlusion=jnp.asarray(-0.05 * rng.random((25, 9))),
        occlusion_slope=jnp.asarray(0.02 * rng.normal(size=(25, 3, 9))),
    )


@functools.cache
def parameters() -> FaceParameters:
    """The bump seen from the front, a little turned."""
    return small_parameters(model())


@functools.cache
def stencil() -> NormalStencil:
    """Of the bump's mesh."""
    return normal_stencil(np.asarray(model().faces), model().vertex_count)


@functools.cache
def samples() -> energies.PixelSamples:
    """Pixels of a random photo of the bump, near the middles of its triangles."""
    rng, faces = np.random.default_rng(9), np.asarray(model().faces)
    middle = np.asarray(screen())[faces, :2].mean(axis=1) / SIDE
    return energies.PixelSamples(
        jnp.asarray(middle), model().faces, jnp.asarray(rng.uniform(0.2, 0.8, (len(faces), 3))),
        jnp.asarray(rng.uniform(0.2, 0.8, len(faces))),
        jnp.array([0.48, 0.53]),
    )  # fmt: skip


@functools.cache
def layout() -> UVLayout:
    """Texels of random triangles, some empty."""
    rng = np.random.default_rng(3)
    triangle = rng.integers(-1, len(model().faces), (8, 8))
    return UVLayout(
        jnp.asarray(triangle),
        jnp.asarray(rng.dirichlet(np.ones(3), (8, 8))[..., 1:]),
        jnp.asarray(triangle >= 0),
        jnp.asarray(rng.uniform(0.5, 2.0, len(model().faces))),
    )


@functools.cache
def network() -> FeatureNetwork:
    """Two blocks of three and four channels, in the present precision."""
    made = random_network(((1, 3), (1, 4)), seed=3)
    return jax.tree.map(lambda x: jnp.asarray(np.asarray(x), float), made)


@functools.cache
def style() -> energies.StyleData:
    """Targets for both layers, with a weight for each."""
    rng = np.random.default_rng(5)
    grams = {"conv1_1": jnp.asarray(rng.random((3, 3))), "conv2_1": jnp.asarray(rng.random((4, 4)))}
    maps = {"conv2_1": jnp.asarray(rng.random((3, 3, 4)))}
    weights = {"conv1_1": jnp.asarray(0.5), "conv2_1": jnp.asarray(2.0)}
    half = {"conv2_1": jnp.asarray(0.5)}
    targets = energies.StyleTargets(grams, maps, jnp.asarray(3.0), weights, half)
    return energies.StyleData(network(), targets)


@functools.cache
def landmarks() -> energies.LandmarkData:
    """Detected near where the bump's landmarks are."""
    rng, points = np.random.default_rng(2), model().landmarks68
    assert points is not None
    return energies.LandmarkData(
        model(), points, jnp.asarray(rng.uniform(0.3, 0.7, (12, 2))),
        jnp.asarray(rng.random(12)), jnp.array([0.5, 0.5]), jnp.asarray(0.3),
    )  # fmt: skip


@functools.cache
def fit_model() -> FitModel:
    """The bump prepared for a fit."""
    points = model().landmarks68
    assert points is not None
    return FitModel(
        model(), stencil(), points, jnp.array([0, 1]), jnp.arange(25),
        jnp.ones(25, bool), jnp.ones(32, bool),
    )  # fmt: skip


@functools.cache
def fit_weights() -> FitWeights:
    """The defaults, as arrays, and one of a term of one's own."""
    return jax.tree.map(jnp.asarray, FitWeights(extra={"mine": 0.5}))


@functools.cache
def fit_input() -> FitInput:
    """A random photo."""
    rng, data = np.random.default_rng(1), landmarks()
    return FitInput(
        jnp.asarray(rng.uniform(0.2, 0.8, (SIDE, SIDE, 3))),
        jnp.asarray(rng.uniform(0.2, 0.8, (SIDE, SIDE))),
        data.target, data.weight, data.unit, data.principal,
        parameters().log_focal, jnp.asarray(0.2), jnp.asarray(True),
    )  # fmt: skip


@functools.cache
def fit_data() -> FitData:
    """What a step of a fit holds fixed."""
    return FitData(
        energies.PhotometricData(model(), samples()), jnp.asarray(0.7), samples(), landmarks(),
        jnp.asarray(0.9), jnp.asarray(np.random.default_rng(4).normal(size=(25, 3, 8))),
        (parameters().log_focal, jnp.asarray(0.2)), fit_weights(),
    )  # fmt: skip


@functools.cache
def exemplar() -> ExemplarTargets:
    """Of a small grey picture, over two octaves."""
    picture = jnp.asarray(np.random.default_rng(8).uniform(0.2, 0.8, (12, 13, 1)))
    weights = jax.tree.map(jnp.asarray, ExemplarWeights())
    colours = colour_axes(picture)
    return exemplar_targets(network(), picture, ("conv1_1", "conv2_1"), 2, weights, colours)


@functools.cache
def pyramid() -> Mipmap:
    """Three levels."""
    return mipmap(jnp.asarray(np.random.default_rng(6).uniform(0.2, 0.8, (8, 9, 3))), 3)


RECORDS: dict[Any, Callable[[], Any]] = {
    MorphableModel: model,
    FaceParameters: parameters,
    NormalStencil: stencil,
    UVLayout: layout,
    FeatureNetwork: network,
    Mipmap: pyramid,
    FitModel: fit_model,
    FitInput: fit_input,
    FitData: fit_data,
    FitWeights: fit_weights,
    energies.PixelSamples: samples,
    energies.LandmarkData: landmarks,
    energies.StyleData: style,
}


def tables() -> dict[str, Any]:
    """Arguments that are not floating-point arrays, by name."""
    return {
        "faces": model().faces, "uv_faces": model().faces,
        "vertices": jnp.asarray(np.random.default_rng(0).integers(0, 25, (12, 3))),
        "height": 5, "width": 6, "levels": 2, "level": 1, "canvas": SIDE, "count": 2, "stride": 1,
        "rounds": 2, "capacity": 20, "side": float(SIDE), "resolution": 8,
        "layers": ("conv1_1", "conv2_1"), "seed": jnp.uint32(3),
    }  # fmt: skip


@functools.cache
def scene() -> dict[str, Any]:
    """Arguments of a renderer."""
    y = parameters()
    return {
        "vertices": model().shape(y.identity, y.expression),
        "faces": model().faces,
        "pose": Pose(y.rotation, y.translation),
        "camera": y.camera(jnp.array([0.48, 0.53]), SIDE),
        "light": y.light,
    }


@functools.cache
def screen() -> Any:
    """The bump's vertices in a picture of ``SIDE`` px."""
    made = scene()
    return made["camera"].project(made["pose"](made["vertices"]))
