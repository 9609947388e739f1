"""Detail of one skin on the complexion of another, in a shared UV layout.

A texture is split by a Gaussian low-pass K into complexion ``K I`` and detail ``I / K I``. The
detail of a database's subject on the photo's own low-frequency albedo is the subject as it would
be with that complexion: statistics of such textures differ by detail alone, and synthesis from
them cannot drift in tone. (The paper compares textures as they are.)
"""

import jax
import jax.numpy as jnp

from jaxface._types import Array, Bool, Float
from jaxface.imaging.colour import rgb_to_yiq, yiq_to_rgb
from jaxface.imaging.low_pass import low_pass
from jaxface.imaging.masks import distance_to, smoothstep

COMPLEXION = 1 / 128
"""standard deviation of K, of the texture's side: 8 texels of 1024, 5 mm on the bundled model"""

STRONGEST = 3.0
"""bound of ``I / K I`` and of its inverse"""

MARK = (4.0, 6.0)
"""depth of a mark, in units of the detail's spread around it: none below, whole above"""

MARK_RIM = 6.0
"""by how much a blurred mark is amplified, so that it covers the spot's rim too"""


@jax.jit
def with_complexion(
    texture: Float[Array, "h w c"],
    low_frequency: Float[Array, "h w c"],
    blur: Float[Array, ""] | float,
) -> Float[Array, "h w c"]:
    """The texture's detail on another's low frequencies: ``L I / K I``, within [0, 1].

    Args:
        texture: sRGB-encoded.
        low_frequency: L, sRGB-encoded.
        blur: of K, texels.
    """
    smooth = _blurred(texture, blur)
    ratio = texture / jnp.maximum(smooth, 1e-3)
    return jnp.clip(low_frequency * jnp.clip(ratio, 1 / STRONGEST, STRONGEST), 0.0, 1.0)


@jax.jit
def without_marks(
    texture: Float[Array, "h w c"],
    plain: Float[Array, "h w"],
    width: Float[Array, ""] | float,
) -> Float[Array, "h w c"]:
    """A texture without its moles: isolated spots far darker than the skin around varies.

    A mark is one person's alone; statistics may be borrowed from a subject, its moles may not.
    They are filled with the detail beside them. What lies dense (freckles, stubble, brows) is no
    mark, nor is what is larger than ``width``.

    Args:
        texture: sRGB-encoded.
        plain: where they are sought, 1 on bare skin, 0 on brows, nostrils, lips and lids.
        width: standard deviation of the low-pass that marks stand out from, texels.
    """
    smooth = jnp.maximum(_blurred(texture, width), 1e-3)
    ratio = texture / smooth
    depth = -jnp.log(jnp.maximum(ratio.mean(-1), 1e-3))

    def around(plane: Array, blur: Array | float) -> Array:
        return jnp.maximum(_blurred(plane[..., None], blur)[..., 0], 0.0)

    wide = 5.0 * jnp.asarray(width)
    spread = jnp.sqrt(around(depth**2, wide))
    # Once more without the marks themselves, or a large one would hide behind its own depth.
    spread = jnp.sqrt(around(jnp.clip(depth, -2 * spread, 2 * spread) ** 2, wide))
    deep = depth / (spread + 0.004)
    # Dense ones are no marks; and the rim of one belongs to it.
    dense = around(smoothstep(deep, 0.6 * MARK[0], MARK[0]), 1.6 * jnp.asarray(width))
    mark = plain * smoothstep(deep, *MARK) * (1 - smoothstep(dense, 0.03, 0.06))
    mark = jnp.clip(MARK_RIM * around(mark, width / 5), 0.0, 1.0)[..., None]
    filled, whole = ratio, mark
    for step in ((1, 0), (0, 1), (-1, -1)):
        shift = jnp.round(2.0 * jnp.asarray(width) * jnp.array(step)).astype(jnp.int32)
        other, hidden = (jnp.roll(x, shift, (0, 1)) for x in (ratio, mark))
        use = whole * (1 - hidden)
        filled, whole = filled + use * (other - filled), whole * hidden
    return jnp.clip(smooth * filled, 0.0, 1.0)


@jax.jit
def with_photo(
    texture: Float[Array, "h w c"],
    photo: Float[Array, "h w c"],
    weight: Float[Array, "h w"],
    blur: Float[Array, ""] | float,
) -> Float[Array, "h w c"]:
    """The photo's frequencies where it is seen, the texture's above them and elsewhere.

    Args:
        texture: sRGB-encoded.
        photo: sRGB-encoded, anything where ``weight`` is 0.
        weight: how far each texel of the photo is to be trusted.
        blur: standard deviation (texels) of the low-pass beyond which the photo holds nothing.
    """
    difference = weight[..., None] * (photo - texture)
    return jnp.clip(texture + _blurred(difference, blur), 0.0, 1.0)


def _blurred(texture: Float[Array, "h w c"], blur: Float[Array, ""] | float) -> Array:
    # Normalised, so that the border of the texture does not darken.
    total = low_pass(jnp.ones_like(texture[..., 0]), blur)[..., None]
    return jax.vmap(lambda plane: low_pass(plane, blur), -1, -1)(texture) / total


@jax.jit
def with_intensity(
    colour: Float[Array, "h w 3"], intensity: Float[Array, "h w"]
) -> Float[Array, "h w 3"]:
    """A texture with another Y of YIQ: the colour of one, the synthesised intensity of the other.

    Chroma is scaled with the intensity, so that dark pores do not turn grey-blue or bright skin
    pale. sRGB-encoded, within [0, 1].
    """
    yiq = rgb_to_yiq(colour)
    gain = jnp.clip(intensity / jnp.maximum(yiq[..., 0], 1e-3), 0.0, STRONGEST)
    chroma = yiq[..., 1:] * gain[..., None]
    return jnp.clip(yiq_to_rgb(jnp.concatenate([intensity[..., None], chroma], axis=-1)), 0, 1)


def soft_inside(free: Bool[Array, "h w"], width: int) -> Float[Array, "h w"]:
    """1 well inside the free texels, falling to 0 over ``width`` texels towards the others."""
    padded = jnp.pad(free, 1)
    distance = distance_to(~padded, width)[1:-1, 1:-1]
    return smoothstep(distance, 0.5, float(width))
