"""What a photo shows of a face's albedo, at one resolution."""

from typing import NamedTuple

import numpy as np

from jaxface._types import Array, Bool, Float


class SeenLevel(NamedTuple):
    """Maps at one level, sRGB-encoded where they are colours.

    Attributes:
        photo: what the photo shows.
        weight: how far it is to be trusted.
        low_frequency: everywhere.
        mask: texels to be synthesised.
        plain: 1 on bare skin.
        texels_per_pixel: texels along a side for one pixel of the photo.
    """

    photo: Float[Array, "r r 3"]
    weight: Float[Array, "r r"]
    low_frequency: Float[Array, "r r 3"]
    mask: Bool[np.ndarray, "r r"]
    plain: Float[Array, "r r"]
    texels_per_pixel: float

    @property
    def side(self) -> int:
        """Texels along a side."""
        return len(self.mask)
