"""Partial albedo -> complete albedo: analysis, blending, synthesis (Saito 2017, secs. 4 to 6)."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float
from jaxface.energies._gram import StyleTargets
from jaxface.imaging.resample import block_means
from jaxface.io.texture_database import TextureDatabase
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.pipeline.databases.grams import find_precomputed, masked_grams
from jaxface.pipeline.texture.options import CompletionOptions
from jaxface.pipeline.texture.records import Blending, Completed, Level, Progress
from jaxface.pipeline.texture.seen import SeenTexture
from jaxface.run.compile_cache import keep_compiled
from jaxface.run.memory import hand_back_freed_memory
from jaxface.stages.blending import Blend, blend
from jaxface.stages.texture._synthesise import SynthesisProblem, SynthesisWeights, synthesise
from jaxface.stages.texture.composition import (
    composed,
    first_intensity,
    known_detail,
    start_texture,
    with_seen,
)
from jaxface.stages.texture.resolutions import free_box, level_steps, resolutions
from jaxface.stages.texture.seen_level import SeenLevel
from jaxface.stages.texture.statistics import (
    Departure,
    box_tile,
    carried_gain,
    kept_weights,
    masked_statistics,
    subject_texture,
    target_statistics,
)

ANALYSIS = 512
"""greatest resolution at which photo and database are compared, unless it is that of the maps"""


def complete(
    seen: SeenTexture,
    database: TextureDatabase,
    network: FeatureNetwork,
    options: CompletionOptions | None = None,
    *,
    blending: Blending | Blend = blend,
    on_progress: Progress = lambda what, done, of, picture: None,
    resumed: Callable[[int], "Level | None"] = lambda level: None,
    finished: Callable[[int, "Level"], None] = lambda level, done: None,
) -> Completed:
    """Complete the albedo of a face from what the photo shows and a database of textures.

    The face's skin is synthesised; scalp, neck and ears get the detail of the database's subject
    with the largest weight, eyes and mouth stay as they are.

    Args:
        seen: what the photo shows, at the resolution wanted.
        database: textures in the same UVs.
        network: extractor of features.
        options: see `CompletionOptions`.
        blending: how statistics are blended, of the arguments of `stages.blend`; for instance
            ``nearest_subject``; or a blend that is known already.
        on_progress: told of every step.
        resumed: a level (texels along a side) that an earlier run has finished.
        finished: told of every finished level.

    Raises:
        ValueError: the database has fewer than two subjects, or the photo shows no skin.
    """
    options = options or CompletionOptions()
    check_subjects(database)
    keep_compiled()
    work = _Work(seen, database, network, options, on_progress)
    blended = blending if isinstance(blending, Blend) else work.blend(blending)
    order = np.argsort(-blended.weights)
    used = [int(i) for i in order if abs(blended.weights[i]) > 1e-3]
    records: list[dict[str, Any]] = []
    start, last = np.zeros(0, np.float32), Level(np.zeros((0, 0), np.float32), {}, {})
    for index, level in enumerate(work.levels):
        hand_back_freed_memory()
        start = work.start(level, used[0])
        done = resumed(level)
        if done is None or done.image.shape != start[work.box(level)].shape[:2]:
            done = work.synthesise(level, start, last.image, blended, used, index)
            finished(level, done)
        records.append(done.record)
        last = done
    return Completed(
        albedo=work.compose(start, last.image),
        start=start,
        blended=blended,
        names=database.names,
        analysed_at=work.analysis_level,
        compared_by=work.compared_by,
        targets=last.targets,
        box=work.box(work.levels[-1]),
        levels=records,
    )


def check_subjects(database: TextureDatabase) -> None:
    """Raise a ValueError if a database has too few subjects to blend."""
    if len(database) < 2:
        raise ValueError(f"database {database.name!r} has {len(database)} subjects; 2 are needed")


class _Work:
    """The textures of one completion at every level, made when they are needed."""

    def __init__(
        self,
        seen: SeenTexture,
        database: TextureDatabase,
        network: FeatureNetwork,
        options: CompletionOptions,
        on_progress: Progress,
    ) -> None:
        self.seen, self.database, self.network = seen, database, network
        self.options, self.on_progress = options, on_progress
        self._detail = seen.detail_map(options.detail)
        side = seen.resolution
        self.levels = resolutions(side) if options.coarse_to_fine else [side]
        self._box = free_box(seen["free"], self.levels)
        sharp = [r for r in self.levels if r <= ANALYSIS and self._texels(r) <= 1.5]
        by_photo = max(sharp, default=self.levels[0])
        self.analysis_level = side if options.compare_at == "maps" else by_photo
        self.compared_by = "network"
        # One level's alone: whole maps of every level would add up.
        self.maps = functools.lru_cache(maxsize=1)(self._maps)

    def _texels(self, level: int) -> float:
        """Texels of a level for one pixel of the photo."""
        return self.seen.texels_per_pixel * level / self.seen.resolution

    def box(self, level: int) -> tuple[slice, slice]:
        factor = self.seen.resolution // level
        (top, left), (bottom, right) = self._box
        return slice(top // factor, bottom // factor), slice(left // factor, right // factor)

    def _mean(self, kind: str, level: int) -> Float[np.ndarray, "r r c"]:
        return self.seen.maps.reduced(kind, level)[0]

    def _maps(self, level: int) -> SeenLevel:
        photo, weight = self.seen.maps.reduced("photo", level)
        return SeenLevel(
            jnp.asarray(photo),
            jnp.asarray(weight),
            jnp.asarray(self._mean("low_frequency", level)),
            self._mean("free", level)[..., 0] > 0.5,
            jnp.asarray(self._mean("plain", level)[..., 0]),
            self._texels(level),
        )

    def subject(self, index: int, level: int, strong: bool = True) -> Array:
        """A subject's texture at a level; ``strong``: as blended and started from, not compared."""
        texture = block_means(self.database.encoded(self.database.names[index]), level)
        return subject_texture(
            texture, self.maps(level), self.options.match_complexion,
            strong and self.options.match_octaves,
        )  # fmt: skip

    def statistics(
        self, texture: Array, mask: Bool[np.ndarray, "r r"], level: int
    ) -> dict[str, Array]:
        return masked_statistics(self.network, texture, mask, self.box(level), self.options.layers)

    def blend(self, blending: Blending) -> Blend:
        """Section 4: compare what the photo shows with the same part of every subject."""
        level = self.analysis_level
        seen = self.maps(level)
        mask = seen.mask & (np.asarray(seen.weight) > 0.5)
        if mask.sum() < 100:
            raise ValueError("the photo shows next to no skin of the face that could be analysed")
        goal = {n: np.asarray(g) for n, g in self.statistics(seen.photo, mask, level).items()}
        columns = self._precomputed(mask, level) or self._compared(mask, tuple(goal))
        return blending(columns, goal, norm=self.options.norm)

    def _precomputed(
        self, mask: Bool[np.ndarray, "r r"], level: int
    ) -> dict[str, Float[np.ndarray, "k n n"]] | None:
        """From what `precompute` keeps, which is of the subjects as they are, in whole maps."""
        whole = self.box(level) == (slice(0, level), slice(0, level))
        if self.options.match_complexion or not whole or self.database.resolution % level:
            return None
        cache = find_precomputed(self.database, self.network, level, layers=self.options.layers)
        if cache is None:
            return None
        self.compared_by = "cache"

        def tell(done: int, of: int) -> None:
            self.on_progress("analysis from kept statistics", done, of, None)

        return masked_grams(cache, mask, tell)

    def _compared(
        self, mask: Bool[np.ndarray, "r r"], layers: Sequence[str]
    ) -> dict[str, Float[np.ndarray, "k n n"]]:
        stacks: dict[str, list[np.ndarray]] = {name: [] for name in layers}
        for index in range(len(self.database)):
            for name, value in self.analysed(index, mask).items():
                stacks[name].append(np.asarray(value))
            self.on_progress("analysis", index + 1, len(self.database), None)
        return {name: np.stack(values) for name, values in stacks.items()}

    def analysed(self, index: int, mask: Bool[np.ndarray, "r r"]) -> dict[str, Array]:
        """A subject's Gram matrices as they are compared with the photo's."""
        level = self.analysis_level
        return self.statistics(self.subject(index, level, strong=False), mask, level)

    def targets(self, level: int, blended: Blend, used: list[int]) -> dict[str, Array]:
        """The complete Gram matrices ``sum_k w_k G(I_k)`` over the subjects that are used."""
        seen, carry = self.maps(level), self.options.carry

        def found() -> Iterator[Departure]:
            for index in used:
                texture = self.subject(index, level)
                own = None if carry is None else with_seen(texture, seen)
                yield (
                    self.statistics(texture, seen.mask, level),
                    None if own is None else self.statistics(own, seen.mask, level),
                )

        gain = 1.0 if carry is None else carried_gain(seen, carry)
        return target_statistics(kept_weights(blended.weights, used), found(), gain)

    def detail(self, level: int) -> Float[Array, "r r"]:
        """How much detail is let in at each texel, 0 to 1."""
        return jnp.asarray(block_means(self._detail[..., None], level)[..., 0])

    def start(self, level: int, nearest: int) -> Float[np.ndarray, "r r 3"]:
        """The texture before synthesis: whole, sRGB-encoded."""
        neighbour = self.options.start == "neighbour"
        subject = self.subject(nearest, level) if neighbour else None
        # The paper starts from the low-frequency albedo alone; what is kept of the photo is shown.
        kept = neighbour or self.options.keep_photo > 0
        return start_texture(
            self.maps(level), subject, self.detail(level), self._mean("skin", level), kept
        )

    def synthesise(
        self,
        level: int,
        start: Float[np.ndarray, "r r 3"],
        coarser: Float[np.ndarray, "h w"],
        blended: Blend,
        used: list[int],
        index: int,
    ) -> Level:
        """Section 5 at one level, from the coarser level's result with the start's finer detail."""
        box = self.box(level)
        first = first_intensity(start[box], coarser)
        seen = self.maps(level)
        goal = self.targets(level, blended, used)
        problem = SynthesisProblem(
            self.network,
            StyleTargets(goal, alpha=self.options.alpha),
            jnp.asarray(seen.mask[box]),
            known_detail(seen, self.detail(level), box),
            SynthesisWeights(self.options.keep_photo, self.options.keep_plain),
        )
        steps = level_steps(self.options.iterations, len(self.levels))[index]
        what = f"synthesis at {level}"

        def on_step(step: int, value: float, image: Callable[[], Array]) -> None:
            self.on_progress(what, step, steps, lambda: self.compose(start, np.asarray(image())))

        hand_back_freed_memory()
        found = synthesise(
            jnp.clip(first, 0.01, 0.99), problem,
            steps=steps, tile=box_tile(*first.shape), on_step=on_step,
        )  # fmt: skip
        record = {
            "name": f"{level} px",
            "values": found.values,
            "terms": found.terms,
            "evaluations": found.evaluations,
        }
        return Level(
            np.asarray(found.image), {name: np.asarray(g) for name, g in goal.items()}, record
        )

    def compose(
        self, start: Float[np.ndarray, "r r 3"], intensity: Float[np.ndarray, "h w"]
    ) -> Float[np.ndarray, "r r 3"]:
        """The synthesised intensity with the start's colour, in the start's surroundings."""
        level = len(start)
        return composed(
            start, intensity, self.box(level), self.maps(level).mask,
            self._mean("inside", level), self.options.fade,
        )  # fmt: skip
