"""Self-supervised training of a feature network whose Gramians tell textures apart.

Two neighbouring crops of one picture show the same texture; crops of other pictures show others.
The network learns to find, by the distance of Gramians alone, the neighbour of each crop among all
crops of a batch: contrastive learning (van den Oord et al. 2018, "InfoNCE"; exemplars as in
Dosovitskiy et al. 2014) with the statistics of Saito 2017, section 4, as the representation,

    d_l(i, j) = ||G^l_i - G^l_j||^2 / (||G^l_i|| ||G^l_j||)
    loss      = mean_l CE(softmax_j(-d_l(i, j) / t_l), j = i)

in both directions, with a learned temperature t_l for each layer. Contrast and brightness of each
crop are changed at random, mirroring and turning by a quarter are common to both. The lowest
quarter of every picture is kept for validation. The start is `random_network`.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax import lax

from jaxface._types import Array, Float
from jaxface.networks.texture_features.network import (
    STYLE_LAYERS,
    FeatureNetwork,
    layer_position,
    pool,
)
from jaxface.networks.texture_features.random_weights import natural_noise, random_network

CROP = 64
"""side of a crop, px"""

TRAINING_ROWS, VALIDATION_ROWS = (0.0, 0.75), (0.75, 1.0)
"""parts of a picture's height"""

GAIN, OFFSET = 0.15, 0.08
"""largest relative change of contrast and largest change of brightness"""

FLAT = 0.012
"""a crop of less contrast than this standard deviation shows no texture and is drawn again"""

SHARPNESS = 3.0
"""1 / t_l at the start, about the inverse of distances between different pictures"""

PEAK_RATE, WARM_UP = 1e-3, 20
_CALIBRATION_SIZE = 128


class Learner(eqx.Module):
    """What is learned: the network, and the temperatures of the distances."""

    network: FeatureNetwork
    log_sharpness: dict[str, Float[Array, ""]]
    """-log t_l"""


class TrainingState(NamedTuple):
    """Everything a run needs to go on; the next step's number says which crops it sees."""

    step: int
    learner: Learner
    optimiser: optax.OptState
    losses: tuple[float, ...]
    """before each step taken"""


def start_training(
    shape: str | tuple[tuple[int, int], ...] = "compact", seed: int = 0, steps: int = 300
) -> TrainingState:
    """The state before the first step: random features, scaled layer by layer.

    Raises:
        ValueError: the shape is unknown, lacks a style layer, or ``steps`` is under 1.
    """
    network = random_network(shape, seed)
    missing = [name for name in STYLE_LAYERS if name not in network.kernels]
    if missing:
        raise ValueError(f"the shape has no {', '.join(missing)}; needed are five blocks")
    learner = Learner(network, {name: jnp.asarray(np.log(SHARPNESS)) for name in STYLE_LAYERS})
    learner = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), learner)
    return TrainingState(0, learner, optimiser(steps).init(learner), ())


def optimiser(steps: int) -> optax.GradientTransformation:
    """Adam with clipped gradients; the rate rises, then falls to zero along a cosine.

    Raises:
        ValueError: ``steps`` is under 1.
    """
    if steps < 1:
        raise ValueError(f"steps is {steps}; at least 1 is needed")
    warm = min(WARM_UP, steps // 2)
    rate = optax.warmup_cosine_decay_schedule(PEAK_RATE / 10, PEAK_RATE, warm, steps)
    return optax.chain(optax.clip_by_global_norm(1.0), optax.adam(rate))


def train(
    pictures: Sequence[Float[np.ndarray, "h w"]],
    steps: int = 300,
    seed: int = 0,
    batch: int = 16,
    shape: str | tuple[tuple[int, int], ...] = "compact",
    state: TrainingState | None = None,
) -> Iterator[TrainingState]:
    """Yield the state after every step; the last one's network is the result.

    A run that goes on from any yielded state gives what an uninterrupted one gives, as step and
    seed alone decide which crops a step sees.

    Args:
        pictures: Y of gamma-encoded pictures in [0, 1]; each at least 256 x 128 px.
        steps: of the whole run; the learning rate's course depends on it.
        seed: of the initial weights and of the crops.
        batch: pairs of crops in a step, at most one pair of a picture where there are enough.
        shape: of the network, see `random_network`.
        state: where to go on; by default from the start.

    Raises:
        ValueError: there are fewer than two pictures, one is too small, holds NaN or is no
            (h, w) array; ``steps`` or ``batch`` is too small; the loss is not finite.
    """
    check_pictures(pictures)
    if batch < 2:
        raise ValueError(f"batch is {batch}; at least 2 pairs are needed to tell apart")
    state = start_training(shape, seed, steps) if state is None else state
    rule = optimiser(steps)

    @jax.jit
    def update(
        learner: Learner, memory: optax.OptState, crops: Float[Array, "2 b s s"]
    ) -> tuple[Array, Learner, optax.OptState]:
        loss, gradient = jax.value_and_grad(contrastive_loss)(learner, crops)
        change, memory = rule.update(gradient, memory)
        return loss, optax.apply_updates(learner, change), memory  # type: ignore[return-value]

    while state.step < steps:
        crops = crop_pairs(pictures, batch, np.random.default_rng((seed, state.step)))
        loss, learner, memory = update(state.learner, state.optimiser, jnp.asarray(crops))
        if not np.isfinite(float(loss)):
            raise ValueError(f"the loss is {float(loss)} at step {state.step}; nothing is learned")
        state = TrainingState(state.step + 1, learner, memory, (*state.losses, float(loss)))
        yield state


def contrastive_loss(learner: Learner, crops: Float[Array, "2 b s s"]) -> Float[Array, ""]:
    """Mean over layers and directions of the cross-entropy of finding a crop's neighbour."""
    pairs = crops.shape[1]
    grams = batch_grams(learner.network, crops.reshape(-1, *crops.shape[2:]))
    target = jnp.arange(pairs)
    losses = []
    for name, gram in grams.items():
        distance = relative_distances(gram[:pairs], gram[pairs:])
        logits = -distance * jnp.exp(learner.log_sharpness[name])
        for scores in (logits, logits.T):
            losses.append(optax.softmax_cross_entropy_with_integer_labels(scores, target).mean())
    return jnp.mean(jnp.stack(losses))


def batch_grams(
    network: FeatureNetwork, images: Float[Array, "b h w"]
) -> dict[str, Float[Array, "b n n"]]:
    """Gramians of the style layers of many small images at once (``grams`` for one large one)."""
    x = jnp.stack([images, jnp.ones_like(images)], axis=-1)
    block, found = 1, {}
    for name in network.layers:
        if layer_position(name)[0] > block:
            block = layer_position(name)[0]
            x = jax.vmap(lambda one: pool(one, network.pooling))(x)
        layout = ("NHWC", "HWIO", "NHWC")
        kernel = network.kernels[name]
        x = lax.conv_general_dilated(x, kernel, (1, 1), "SAME", dimension_numbers=layout)
        x = jnp.maximum(x + network.biases[name], 0)
        if name in STYLE_LAYERS:
            found[name] = jnp.einsum("bhwi,bhwj->bij", x, x) / (x.shape[1] * x.shape[2])
    return found


def relative_distances(
    first: Float[Array, "a n n"], second: Float[Array, "b n n"]
) -> Float[Array, "a b"]:
    """``||G_i - G_j||^2 / (||G_i|| ||G_j||)``: no scale of the responses changes it."""
    first, second = first.reshape(len(first), -1), second.reshape(len(second), -1)
    a = jnp.sqrt(jnp.sum(first**2, axis=1) + 1e-12)
    b = jnp.sqrt(jnp.sum(second**2, axis=1) + 1e-12)
    ratio = a[:, None] / b[None, :]
    return ratio + 1 / ratio - 2 * (first / a[:, None]) @ (second / b[:, None]).T


def crop_pairs(
    pictures: Sequence[Float[np.ndarray, "h w"]],
    count: int,
    generator: np.random.Generator,
    rows: tuple[float, float] = TRAINING_ROWS,
    vary: bool = True,
) -> Float[np.ndarray, "2 count s s"]:
    """Pairs of crops that lie side by side, each pair of another picture while there are any.

    ``vary``: change contrast and brightness of each crop, mirror and turn both alike.
    """
    order = [generator.permutation(len(pictures)) for _ in range(-(-count // len(pictures)))]
    pairs = np.empty((count, 2, CROP, CROP), np.float32)
    for pair, index in zip(pairs, np.concatenate(order)[:count], strict=True):
        height, width = pictures[index].shape
        low, high = int(np.ceil(rows[0] * height)), int(rows[1] * height) - CROP
        for _ in range(8):
            y, x = generator.integers(low, high + 1), generator.integers(0, width - 2 * CROP + 1)
            strip = pictures[index][y : y + CROP, x : x + 2 * CROP]
            pair[0], pair[1] = strip[:, :CROP], strip[:, CROP:]
            if pair.std(axis=(1, 2)).min() > FLAT:
                break
        if vary:
            turned = pair[:, ::-1] if generator.random() < 0.5 else pair
            pair[:] = np.rot90(turned, int(generator.integers(4)), (1, 2)).copy()
            gain = np.exp(generator.uniform(-GAIN, GAIN, (2, 1, 1)))
            mean = pair.mean(axis=(1, 2), keepdims=True)
            offset = generator.uniform(-OFFSET, OFFSET, (2, 1, 1))
            pair[:] = np.clip(mean + gain * (pair - mean) + offset, 0, 1)
    return np.swapaxes(pairs, 0, 1)


def check_pictures(pictures: Sequence[Float[np.ndarray, "h w"]]) -> None:
    """Whether all can be cropped.

    Raises:
        ValueError: there are fewer than two, or one is too small, not (h, w) or not finite.
    """
    if len(pictures) < 2:
        raise ValueError(f"{len(pictures)} pictures are given; at least 2 are needed")
    for index, picture in enumerate(pictures):
        if picture.ndim != 2 or picture.shape[0] < 4 * CROP or picture.shape[1] < 2 * CROP:
            raise ValueError(
                f"picture {index} has shape {picture.shape}; needed is one channel, at least "
                f"{4 * CROP} rows and {2 * CROP} columns"
            )
        if not np.isfinite(picture).all():
            raise ValueError(f"picture {index} holds values that are not finite")


def identification(
    network: FeatureNetwork, pictures: Sequence[Float[np.ndarray, "h w"]], pairs: int = 64
) -> float:
    """Share of crops of the kept rows whose nearest Gramians are their neighbour's.

    The distance is the sum over layers of the root of `relative_distances`; nothing is changed at
    random, and the same pictures give the same pairs.
    """
    crops = crop_pairs(pictures, pairs, np.random.default_rng(0), VALIDATION_ROWS, vary=False)
    of_network = jax.jit(lambda images: batch_grams(network, images))
    first, second = of_network(jnp.asarray(crops[0])), of_network(jnp.asarray(crops[1]))
    distance = sum(
        np.sqrt(np.maximum(relative_distances(first[name], second[name]), 0)) for name in first
    )
    right = [np.argmin(distance, axis=axis) == np.arange(pairs) for axis in (0, 1)]
    return float(np.mean(right))


def equalised(network: FeatureNetwork) -> FeatureNetwork:
    """The network with all layers equally loud, and otherwise the same.

    As ReLUs commute with positive factors, each layer can be scaled and the next one's kernel
    divided by as much. On the noise picture that `random_network` is scaled by, the mean square of
    each layer's responses becomes 1, so that alpha of eq. 3 means the same for all networks;
    relative distances of Gramians do not change.
    """
    picture = natural_noise(_CALIBRATION_SIZE, np.random.default_rng(0)).astype(np.float32)
    x = jnp.stack([jnp.asarray(picture), jnp.ones_like(picture)], axis=-1)
    kernels, biases, block, before = {}, {}, 1, 1.0
    for name in network.layers:
        if layer_position(name)[0] > block:
            block = layer_position(name)[0]
            x = pool(x, network.pooling)
        kernel, bias = network.kernels[name] / before, network.biases[name]
        layout = ("NHWC", "HWIO", "NHWC")
        y = lax.conv_general_dilated(x[None], kernel, (1, 1), "SAME", dimension_numbers=layout)[0]
        y = jnp.maximum(y + bias, 0)
        before = 1 / jnp.sqrt(jnp.maximum(jnp.mean(y**2), 1e-12))
        kernels[name], biases[name] = kernel * before, bias * before
        x = y * before
    return FeatureNetwork(
        kernels, biases, pooling=network.pooling, name=network.name, licence=network.licence
    )
