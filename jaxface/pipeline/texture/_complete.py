"""Partial albedo -> complete albedo: analysis, blending, synthesis (Saito 2017, secs. 4 to 6)."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxface._types import Array, Bool, Float
from jaxface.energies._gram import StyleTargets, grams, mask_out
from jaxface.energies.known_detail import KnownDetail
from jaxface.imaging.colour import rgb_to_yiq
from jaxface.imaging.push_pull import push_pull
from jaxface.imaging.resample import block_means, resize
from jaxface.io.texture_database import TextureDatabase
from jaxface.networks.texture_features.network import FeatureNetwork
from jaxface.networks.texture_features.tiles import even_tile
from jaxface.pipeline.texture.completion_levels import faded, level_steps, nearest_positive
from jaxface.pipeline.texture.records import (
    Blending,
    Completed,
    CompletionSettings,
    Level,
    Progress,
)
from jaxface.pipeline.texture.seen import SeenTexture
from jaxface.run.memory import hand_back_freed_memory
from jaxface.stages.blending import Blend, blend
from jaxface.stages.texture._synthesise import SynthesisProblem, synthesise
from jaxface.stages.texture.detail import (
    COMPLEXION,
    with_complexion,
    with_intensity,
    with_photo,
    without_marks,
)
from jaxface.stages.texture.octaves import with_photos_octaves

COARSEST = 256
ANALYSIS = 512
"""greatest resolution at which photo and database are compared"""

PHOTO_BLUR = 0.6
"""standard deviation of the low-pass that passes what a photo holds, in its pixels"""

LARGEST_GAIN = 3.0
"""by which what a small part of the face shows is taken to hold for the whole"""

LARGEST_WHOLE = 1 << 20
"""texels up to which statistics are taken in one piece; beyond, in tiles"""


def complete(
    seen: SeenTexture,
    database: TextureDatabase,
    network: FeatureNetwork,
    settings: CompletionSettings | None = None,
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
        settings: see `CompletionSettings`.
        blending: how statistics are blended, of the arguments of `stages.blend.blend`; for
            instance ``nearest_subject``; or a blend that is known already.
        on_progress: told of every step.
        resumed: a level (texels along a side) that an earlier run has finished.
        finished: told of every finished level.

    Raises:
        ValueError: the database has fewer than two subjects, or the photo shows no skin.
    """
    settings = settings or CompletionSettings()
    check_subjects(database)
    work = _Work(seen, database, network, settings, on_progress, blending)
    blended = work.blend()
    order = np.argsort(-blended.weights)
    used = [int(i) for i in order if abs(blended.weights[i]) > 1e-3]
    records: list[dict[str, Any]] = []
    start, last = np.zeros(0, np.float32), Level(np.zeros((0, 0), np.float32), {}, {})
    for index, level in enumerate(work.levels):
        hand_back_freed_memory()
        start = work.start(level, used[0])
        done = resumed(level)
        if done is None or done.image.shape != work.cut(start, level).shape[:2]:
            done = work.synthesise(level, start, last.image, blended, used, index)
            finished(level, done)
        records.append(done.record)
        last = done
    return Completed(
        work.compose(start, last.image),
        start,
        blended,
        database.names,
        work.analysis_level,
        last.targets,
        work.box(work.levels[-1]),
        records,
    )


def check_subjects(database: TextureDatabase) -> None:
    """Raise a ValueError if a database has too few subjects to blend."""
    if len(database) < 2:
        raise ValueError(f"database {database.name!r} has {len(database)} subjects; 2 are needed")


class _Maps(NamedTuple):
    """What was seen, at one level."""

    photo: Float[Array, "r r 3"]
    """what the photo shows, sRGB-encoded"""
    weight: Float[Array, "r r"]
    """how far it is to be trusted"""
    low_frequency: Float[Array, "r r 3"]
    mask: Bool[np.ndarray, "r r"]
    """texels to be synthesised"""
    plain: Float[Array, "r r"]


class _Work:
    """The textures of one completion at every level, made when they are needed."""

    def __init__(
        self,
        seen: SeenTexture,
        database: TextureDatabase,
        network: FeatureNetwork,
        settings: CompletionSettings,
        on_progress: Progress,
        blending: Blending | Blend,
    ) -> None:
        self.seen, self.database, self.network = seen, database, network
        self.settings, self.on_progress, self.blending = settings, on_progress, blending
        self._detail = seen.detail_map(settings.detail)
        self.levels = [seen.resolution]
        while self.levels[0] >= 2 * COARSEST and self.levels[0] % 2 == 0:
            self.levels.insert(0, self.levels[0] // 2)
        rows, columns = np.nonzero(seen.free)
        grain = seen.resolution // self.levels[0] * 16
        low = (np.array([rows.min(), columns.min()]) // grain - 1).clip(0) * grain
        high = (np.array([rows.max(), columns.max()]) // grain + 2) * grain
        self._box = low, high.clip(max=seen.resolution)
        sharp = [r for r in self.levels if r <= ANALYSIS and self._texels(r) <= 1.5]
        self.analysis_level = max(sharp, default=self.levels[0])
        self._grams = jax.jit(
            lambda net, image, tile: grams(image, net, layers=settings.layers, tile=tile),
            static_argnums=2,
        )
        # One level's alone: whole maps of every level would add up.
        self.maps = functools.lru_cache(maxsize=1)(self._maps)

    def _texels(self, level: int) -> float:
        """Texels of a level for one pixel of the photo."""
        return self.seen.texels_per_pixel * level / self.seen.resolution

    def box(self, level: int) -> tuple[slice, slice]:
        factor = self.seen.resolution // level
        (top, left), (bottom, right) = (corner // factor for corner in self._box)
        return slice(int(top), int(bottom)), slice(int(left), int(right))

    def tile(self, level: int) -> int | None:
        """Side of the tiles in which a level's statistics are summed; None for the whole box."""
        height, width = (part.stop - part.start for part in self.box(level))
        return even_tile((height, width)) if height * width > LARGEST_WHOLE else None

    def cut(self, texture: Any, level: int) -> Any:
        return texture[self.box(level)]

    def _maps(self, level: int) -> _Maps:
        seen = self.seen
        weight = block_means(seen.weight[..., None], level)
        colour = block_means(seen.photo * seen.weight[..., None], level)
        return _Maps(
            jnp.asarray(colour / np.maximum(weight, 1e-3)),
            jnp.asarray(weight[..., 0]),
            jnp.asarray(block_means(seen.low_frequency, level)),
            block_means(seen.free[..., None].astype(np.float32), level)[..., 0] > 0.5,
            jnp.asarray(block_means(seen.plain[..., None], level)[..., 0]),
        )

    def subject(self, index: int, level: int, strong: bool = True) -> Array:
        """A subject's texture at a level, on the photo's complexion if the settings say so.

        With ``strong`` also with detail as strong as the photo's: not where they are compared.
        """
        texture = block_means(self.database.encoded(self.database.names[index]), level)
        if texture.shape[0] < level:
            texture = resize(jnp.asarray(texture), level, level)
        if not self.settings.match_complexion:
            return jnp.asarray(texture)
        seen = self.maps(level)
        bare = without_marks(jnp.asarray(texture), seen.plain, level * COMPLEXION)
        own = with_complexion(bare, seen.low_frequency, level * COMPLEXION)
        if not (strong and self.settings.match_octaves):
            return own
        weight = seen.weight * seen.mask
        return with_photos_octaves(own, seen.photo, weight, self._texels(level))

    def statistics(self, texture: Array, mask: np.ndarray, level: int) -> dict[str, Array]:
        """Gram matrices of a texture's intensity, masked out beyond a mask, in the box."""
        shown = mask_out(rgb_to_yiq(texture)[..., 0], jnp.asarray(mask))
        return self._grams(self.network, self.cut(shown, level), self.tile(level))

    def blend(self) -> Blend:
        """Section 4: compare what the photo shows with the same part of every subject."""
        if isinstance(self.blending, Blend):
            return self.blending
        level, count = self.analysis_level, len(self.database)
        seen = self.maps(level)
        mask = seen.mask & (np.asarray(seen.weight) > 0.5)
        if mask.sum() < 100:
            raise ValueError("the photo shows next to no skin of the face that could be analysed")
        target = self.statistics(seen.photo, mask, level)
        stacks: dict[str, list[np.ndarray]] = {name: [] for name in target}
        for index in range(count):
            for name, value in self.analysed(index, mask).items():
                stacks[name].append(np.asarray(value))
            self.on_progress("analysis", index + 1, count, None)
        columns = {name: np.stack(values) for name, values in stacks.items()}
        goal = {name: np.asarray(value) for name, value in target.items()}
        return self.blending(columns, goal, norm=self.settings.norm)

    def analysed(self, index: int, mask: np.ndarray) -> dict[str, Array]:
        """A subject's Gram matrices as they are compared with the photo's."""
        level = self.analysis_level
        return self.statistics(self.subject(index, level, strong=False), mask, level)

    def targets(self, level: int, blended: Blend, used: list[int]) -> dict[str, Array]:
        """The complete Gram matrices ``sum_k w_k G(I_k)``."""
        # What was left out is made up for, so that the sum of the weights stays as it was.
        weights = blended.weights[used] * (blended.weights.sum() / blended.weights[used].sum())
        total: dict[str, Array] = {}
        mask, carry = self.maps(level).mask, self.settings.carry
        for share, index in zip(weights, used, strict=True):
            texture = self.subject(index, level)
            found = self.statistics(texture, mask, level)
            if carry is not None:
                own = self.statistics(self.with_photo(texture, level), mask, level)
                gain = self.gain(level, carry)
                found = {name: g + gain * (own[name] - g) for name, g in found.items()}
            for name, value in found.items():
                total[name] = share * value + total.get(name, 0.0)
        return {name: nearest_positive(value) for name, value in total.items()}

    def gain(self, level: int, carry: float) -> float:
        """What the seen skin's departure counts: 1, or as if the whole face departed like it."""
        seen = self.maps(level)
        weight = np.asarray(seen.weight)[seen.mask]
        return 1 + carry * min(1 / max(float(weight.mean()), 1e-3) - 1, LARGEST_GAIN - 1)

    def with_photo(self, texture: Array, level: int) -> Array:
        """A texture with the frequencies that the photo holds, where it is seen."""
        seen = self.maps(level)
        return with_photo(texture, seen.photo, seen.weight, PHOTO_BLUR * self._texels(level))

    def detail(self, level: int) -> Float[Array, "r r"]:
        """How much detail is let in at each texel, 0 to 1."""
        return jnp.asarray(block_means(self._detail[..., None], level)[..., 0])

    def start(self, level: int, nearest: int) -> Float[np.ndarray, "r r 3"]:
        """The texture before synthesis: whole, sRGB-encoded."""
        low = texture = self.maps(level).low_frequency
        if self.settings.start == "neighbour":
            texture = low + self.detail(level)[..., None] * (self.subject(nearest, level) - low)
        texture = self.with_photo(texture, level)
        skin = block_means(self.seen.skin[..., None].astype(np.float32), level)
        return np.asarray(skin * texture + (1 - skin) * low)

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
        first = self.cut(rgb_to_yiq(jnp.asarray(start))[..., 0], level)
        if coarser.size:
            lower = resize(first[..., None], *coarser.shape)
            first = first + resize(jnp.asarray(coarser)[..., None] - lower, *first.shape)[..., 0]
        seen = self.maps(level)
        free = self.cut(seen.mask, level)
        known = KnownDetail(
            self.cut(rgb_to_yiq(seen.photo)[..., 0], level),
            self.cut(seen.weight, level) * free,
            self.cut(rgb_to_yiq(seen.low_frequency)[..., 0], level),
            self.cut(self.detail(level), level),
            jnp.asarray(PHOTO_BLUR * self._texels(level), first.dtype),
        )
        goal = self.targets(level, blended, used)
        targets = StyleTargets(goal, alpha=self.settings.alpha)
        problem = SynthesisProblem(
            self.network, targets, jnp.asarray(free), known, self.settings.weights
        )
        steps = level_steps(self.settings.iterations, len(self.levels))[index]
        what = f"synthesis at {level}"

        def on_step(step: int, value: float, image: Callable[[], Array]) -> None:
            self.on_progress(what, step, steps, lambda: self.compose(start, np.asarray(image())))

        hand_back_freed_memory()
        found = synthesise(
            jnp.clip(first, 0.01, 0.99),
            problem,
            steps=steps,
            tile=self.tile(level),
            on_step=on_step,
        )
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
        box = self.box(level)
        colour = jnp.asarray(start[box])
        first = rgb_to_yiq(colour)[..., 0]
        change = jnp.asarray(intensity) - first
        mixed = first + faded(change, self.cut(self.maps(level).mask, level), level)
        whole = np.array(start)
        whole[box] = np.asarray(with_intensity(colour, mixed))
        inside = block_means(self.seen.inside[..., None].astype(np.float32), level)
        # Between the charts the nearest colours continue, so that a filter finds no dark rim.
        return np.asarray(push_pull(jnp.asarray(whole), jnp.asarray(inside[..., 0] > 0.99, float)))
