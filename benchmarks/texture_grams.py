"""Gram matrices of varied skin-like textures, for problems of blending with a real spectrum.

Small procedural textures (a tone, shading, mottling of several slopes, pores, freckles, wrinkles
and stubble in random strengths) pass a network with random weights of VGG's channel counts
(64, 128, 256, 512, 512), one 3x3 convolution and ReLU a level, average pooling between them; the
Gram matrices ``F F^T / M`` of the five levels are the columns. They are strongly correlated, as
those of photographs are, and nothing like Gaussian noise. Textures of the database and targets
come from the same random stream, so a target is no member of the database.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

LAYERS = ("conv1_1", "conv2_1", "conv3_1", "conv4_1", "conv5_1")
CHANNELS = (64, 128, 256, 512, 512)


def textures(count: int, size: int = 64, seed: int = 0) -> np.ndarray:
    """Grey textures (count, size, size) in [0, 1]."""
    rng = np.random.default_rng(seed)
    fx = np.fft.fftfreq(size)[:, None]
    fy = np.fft.fftfreq(size)[None, :]
    radius = np.hypot(fx, fy)
    radius[0, 0] = 1.0
    y, x = np.mgrid[0:size, 0:size] / size
    out = np.empty((count, size, size), np.float32)
    for image in out:

        def noise(spectrum: np.ndarray) -> np.ndarray:
            field = np.fft.ifft2(np.fft.fft2(rng.normal(size=(size, size))) * spectrum).real
            return (field - field.mean()) / (field.std() + 1e-12)

        mottled = noise(radius ** -rng.uniform(0.5, 2.5))
        centre, width = rng.uniform(0.08, 0.35), rng.uniform(0.02, 0.08)
        pores = noise(np.exp(-(((radius - centre) / width) ** 2)))
        angle = rng.uniform(0, np.pi)
        along = np.abs(np.cos(angle) * fx + np.sin(angle) * fy)
        wrinkles = noise(np.exp(-((along / 0.03) ** 2)) * np.exp(-((radius / 0.25) ** 2)))
        freckles = noise(np.exp(-((radius / rng.uniform(0.05, 0.2)) ** 2)))
        stubble = rng.random((size, size)) < rng.uniform(0, 0.12) * rng.integers(0, 2)
        direction = rng.uniform(-1, 1, 2)
        image[:] = (
            rng.uniform(0.25, 0.75)
            + rng.uniform(0, 0.15) * (direction[0] * (x - 0.5) + direction[1] * (y - 0.5))
            + rng.gamma(2.0, 0.015) * mottled
            + rng.gamma(1.5, 0.015) * pores
            + rng.gamma(1.0, 0.015) * wrinkles
            - rng.uniform(0, 0.25) * (freckles > rng.uniform(1.5, 3.0))
            - rng.uniform(0.05, 0.3) * stubble
        )
    return np.clip(out, 0, 1)


@functools.partial(jax.jit, static_argnames="channels")
def _grams(images: jax.Array, channels: tuple[int, ...]) -> list[jax.Array]:
    keys = jax.random.split(jax.random.key(7), len(channels))
    x = images[..., None] - 0.5
    found = []
    for level, (key, n) in enumerate(zip(keys, channels, strict=True)):
        if level:
            shape = (1, 2, 2, 1)
            x = jax.lax.reduce_window(x, 0.0, jax.lax.add, shape, shape, "VALID") / 4
        kernel = jax.random.normal(key, (3, 3, x.shape[-1], n)) * np.sqrt(2 / (9 * x.shape[-1]))
        x = jax.nn.relu(
            jax.lax.conv_general_dilated(
                x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
        )
        flat = x.reshape(len(x), -1, n)
        found.append(jnp.einsum("bmi,bmj->bij", flat, flat) / flat.shape[1])
    return found


def problem(
    count: int, targets: int, *, channels: tuple[int, ...] = CHANNELS, size: int = 64, seed: int = 0
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Database ``{layer: (count, n, n)}`` and targets ``{layer: (targets, n, n)}``, float32."""
    images = textures(count + targets, size, seed)
    names = LAYERS[: len(channels)]
    out = {
        name: np.empty((len(images), n, n), np.float32)
        for name, n in zip(names, channels, strict=True)
    }
    for start in range(0, len(images), 16):
        block = images[start : start + 16]
        for name, gram in zip(names, _grams(jnp.asarray(block), channels), strict=True):
            out[name][start : start + 16] = gram
    return (
        {name: gram[:count] for name, gram in out.items()},
        {name: gram[count:] for name, gram in out.items()},
    )
