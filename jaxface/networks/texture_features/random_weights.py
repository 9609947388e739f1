"""Feature networks with deterministic random weights, scaled so that all layers speak equally loud.

Random filters already carry much of a texture's statistics (Ustyuzhaninov et al. 2017, "What does
it take to generate natural textures?"). Each filter has zero mean, so no layer responds to plain
grey. Each layer is then scaled on a seeded noise picture with the spectrum of natural images, from
the image on (layer-sequential unit variance; Mishkin and Matas 2016): before the ReLU every
channel has mean 0 and standard deviation ``sqrt(2)``, so that the mean square of a layer's
responses, the mean of its Gramian's diagonal, is about 1.
"""

import jax.numpy as jnp
import numpy as np

from jaxface._types import Float
from jaxface.networks.convolution.conv3x3 import direct_conv3x3
from jaxface.networks.texture_features.network import FeatureNetwork, pool, with_indicator

SHAPES: dict[str, tuple[tuple[int, int], ...]] = {
    "vgg19": ((2, 64), (2, 128), (4, 256), (4, 512), (1, 512)),
    "vgg16": ((2, 64), (2, 128), (3, 256), (3, 512), (1, 512)),
    "compact": ((2, 32), (2, 64), (2, 128), (2, 128), (1, 128)),
}
"""(convolutions, channels) of each block; VGG up to conv5_1"""

_CALIBRATION_SIZE = 128


def random_network(
    shape: str | tuple[tuple[int, int], ...] = "vgg19", seed: int = 0, pooling: str = "average"
) -> FeatureNetwork:
    """A network of random weights; the same arguments give the same weights.

    Args:
        shape: one of ``SHAPES``, or the number of convolutions and of channels of each block.
        seed: of the filters and of the calibration picture.
        pooling: ``average`` or ``max``.

    Raises:
        ValueError: the shape is unknown.
    """
    name = shape if isinstance(shape, str) else "custom"
    if isinstance(shape, str):
        if shape not in SHAPES:
            raise ValueError(f"shape is {shape!r}; needed is one of {sorted(SHAPES)} or pairs")
        shape = SHAPES[shape]
    generator = np.random.default_rng(seed)
    picture = natural_noise(_CALIBRATION_SIZE, generator).astype(np.float32)
    x = with_indicator(jnp.asarray(picture))
    kernels, biases = {}, {}
    for block, (count, channels) in enumerate(shape, start=1):
        x = pool(x, pooling) if block > 1 else x
        for index in range(1, count + 1):
            layer = f"conv{block}_{index}"
            inputs = 1 if not kernels else x.shape[-1]
            kernel = generator.standard_normal((3, 3, inputs, channels), dtype=np.float32)
            kernel -= kernel.mean(axis=(0, 1, 2))
            if not kernels:
                # The image counts from middle grey, so that the zeros around it are grey too.
                kernel = np.concatenate([kernel, -0.5 * kernel], axis=2)
            y = np.asarray(direct_conv3x3(x, jnp.asarray(kernel)), np.float64)
            gain = np.sqrt(2) / np.maximum(y.std(axis=(0, 1)), 1e-12)
            kernels[layer] = jnp.asarray(kernel * gain, jnp.float32)
            biases[layer] = jnp.asarray(-y.mean(axis=(0, 1)) * gain, jnp.float32)
            x = jnp.maximum(jnp.asarray(y * gain, jnp.float32) + biases[layer], 0)
    return FeatureNetwork(
        kernels,
        biases,
        pooling=pooling,
        name=f"random {name}",
        licence=f"random numbers (seed {seed}); no licence needed",
    )


def natural_noise(size: int, generator: np.random.Generator) -> Float[np.ndarray, "size size"]:
    """Gaussian noise with amplitude falling as 1/frequency, mean 0.5 and deviation 0.15."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf
    spectrum = np.fft.fft2(generator.standard_normal((size, size))) / frequency
    noise = np.real(np.fft.ifft2(spectrum))
    return np.clip(0.5 + 0.15 * noise / noise.std(), 0, 1)
