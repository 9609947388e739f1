"""How a texture is completed."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from jaxface.energies._gram import DETAIL_WEIGHT
from jaxface.networks.texture_features.network import STYLE_LAYERS

CHOICES = {
    "norm": ("frobenius", "squared"),
    "start": ("neighbour", "low_frequency"),
    "compare_at": ("photo", "maps"),
    "extent": ("face", "whole"),
}
"""values of the options that are one of a few"""


@dataclass(frozen=True)
class CompletionOptions:
    """How a texture is completed; every default stands here and nowhere else.

    Raises:
        ValueError: a value is out of range; the message names it.
        TypeError: there is no such option.
    """

    alpha: float = field(default=DETAIL_WEIGHT, metadata={"help": "Weight of detail, equation 3."})
    norm: str = field(
        default="frobenius",
        metadata={"help": "Of the blend, equation 2: frobenius (the paper's) or squared."},
    )
    """``frobenius`` (the paper's sum of unsquared norms) or ``squared``"""
    iterations: int = field(
        default=1000, metadata={"help": "Steps of the synthesis over all resolutions."}
    )
    """L-BFGS steps in all, most of them at the coarse levels"""
    layers: tuple[str, ...] = STYLE_LAYERS
    """L_G of eq. 3, and the layers that are compared in eq. 2"""
    keep_photo: float = field(
        default=30.0, metadata={"help": "Weight of what the photo shows; 0 as in the paper."}
    )
    keep_plain: float = 30.0
    """weight of the low frequencies where ``detail`` is below 1"""
    detail: Mapping[str, float] = field(
        default_factory=dict, metadata={"help": "Detail by region from 0 to 1, as lips=0.5,nose=1."}
    )
    """by region of the model: 1 lets detail in, 0 keeps the low frequencies; 1 where not named"""
    start: str = field(
        default="neighbour", metadata={"help": "neighbour, or low_frequency as in the paper."}
    )
    """first intensities: ``neighbour`` (detail of the subject of the largest weight) or
    ``low_frequency`` (the paper's)"""
    match_complexion: bool = True
    """compare and blend the subjects' detail on the photo's complexion; False: as in the paper,
    where tone counts too"""
    match_octaves: bool = True
    """whether subjects whose complexion is matched get each octave of detail as strong as the
    photo's"""
    carry: float | None = 1.0
    """how far the hidden skin departs from the blend as the seen does; 0: the blend's as it is;
    None: as in the paper, where the seen skin's statistics are the blend's, too"""
    plausible: bool = True
    """take gloss, leftover shading, folds and hair out of what is seen, and continue its complexion
    over what is not; False: as in the paper, the partial albedo and the model's own as they are"""
    compare_at: str = "photo"
    """resolution at which photo and database are compared: the ``photo``'s, 512 at most, or that of
    the ``maps``, as in the paper"""
    extent: str = "face"
    """what is synthesised: skin of the ``face``, or the ``whole`` map, as in the paper"""
    coarse_to_fine: bool = True
    """False: one resolution, as in the paper"""
    fade: bool = True
    """fade what was synthesised into its surroundings and scale chroma with it; False: as in the
    paper, the Y found with I and Q of the start"""

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}; it must be {' or '.join(map(repr, known))}"
                )
        if self.iterations < 1:
            raise ValueError(f"iterations is {self.iterations}; at least one is needed")
        for name in ("alpha", "keep_photo", "keep_plain"):
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(
                    f"{name} is {getattr(self, name)}; weights of 0 or more are needed"
                )
        if not self.layers:
            raise ValueError("layers is empty; at least one layer is needed")
        for region, value in self.detail.items():
            if not 0 <= value <= 1:
                raise ValueError(f"detail of {region!r} is {value}; it needs to be in [0, 1]")

    @classmethod
    def as_published(cls) -> "CompletionOptions":
        """Saito 2017 as printed: every departure switched off at once.

        Subjects are compared as they are, at the resolution of the maps; the blend's statistics are
        the target; the whole map is synthesised at one resolution from the low-frequency albedo;
        I and Q stay those of the low-frequency albedo. L_F is empty, as in the paper's experiments
        (section 6: the low-frequency albedo is used "for initialization" alone).
        """
        return cls(
            keep_photo=0.0, start="low_frequency", match_complexion=False, match_octaves=False,
            carry=None, plausible=False, compare_at="maps", extent="whole", coarse_to_fine=False,
            fade=False,
        )  # fmt: skip


def parse_detail(text: str) -> dict[str, float]:
    """`CompletionOptions.detail` from text such as ``lips=0.5,nose=1``.

    Raises:
        ValueError: it cannot be read.
    """
    regions = {}
    for part in text.split(","):
        name, _, value = part.partition("=")
        try:
            regions[name.strip()] = float(value)
        except ValueError:
            raise ValueError(f"--detail has {part!r}; region=value is needed") from None
    return regions
