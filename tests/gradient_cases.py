"""What the walk over all gradients cannot read from an annotation: scenes, and what is left out."""

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from jaxface import energies, render, stages
from jaxface._numerics import above_rounding
from jaxface.energies.exemplar import exemplar_gram_residual
from jaxface.energies.term import Term, compose
from jaxface.geometry.nearest_rotation import rotation_change
from jaxface.geometry.normal_stencil import normal_derivative
from jaxface.geometry.rotation import rotation_matrices, rotation_matrix
from jaxface.imaging.masks import smoothstep
from jaxface.imaging.mipmap import Mipmap
from jaxface.imaging.suv import remove_specular_peak
from jaxface.models.face_oval import face_oval
from jaxface.models.skin.patch import patch_at
from jaxface.models.skin.pigments import Density
from jaxface.models.skin.regions import SkinFields
from jaxface.networks.texture_features.network import features
from jaxface.networks.texture_features.tiles import sum_over_tiles, tile_of_map
from jaxface.render._rasterize import rasterize
from jaxface.stages.fit.objective import fit_energy
from jaxface.stages.fit.records import FitConfig, FitInput, FitWeights
from jaxface.stages.fit.solve import observe
from jaxface.stages.fit.start import initial_light
from jaxface.stages.fit.visible import visible_samples
from jaxface.stages.texture._synthesise import SynthesisWeights
from jaxface.stages.texture.composition import with_seen
from jaxface.stages.texture.seen_level import SeenLevel
from tests.gradient_inputs import (
    SIDE,
    exemplar,
    fit_data,
    fit_input,
    fit_model,
    fit_weights,
    layout,
    model,
    network,
    parameters,
    pyramid,
    samples,
    scene,
    screen,
    stencil,
    style,
)
from tests.gradient_walk import Maker


@dataclasses.dataclass(frozen=True)
class Case:
    """A function with its arguments, by name.

    ``held`` gives, by an argument's name, the reason why what a function returns does
    not follow that argument as a finite difference does. ``singular`` says why differences mean
    nothing at the singular points, where derivatives are then only finite and alike.
    """

    fn: Callable[..., Any]
    arguments: dict[str, Any]
    held: Mapping[str, str] = dataclasses.field(default_factory=dict)
    singular: str = ""


def sized(fn: Callable[..., Any]) -> Callable[..., Any]:
    """With height and width of a picture."""
    return functools.partial(fn, height=SIDE, width=SIDE)


CASES: dict[str, Callable[[Maker], Case]] = {}
"""by dotted name: a function of a ``Maker``"""


def simple(
    name: str,
    fn: Callable[..., Any],
    make: Callable[[Maker], dict[str, Any]],
    singular: str = "",
    **held: str,
) -> None:
    """A case whose arguments are made by a short function."""
    CASES[name] = lambda maker: Case(fn, make(maker), held, singular)


def nearest(height: int, width: int, cull: bool, near: float) -> Callable[[Any, Any], Any]:
    """What ``render._rasterize._nearest`` does, for few triangles and in a line or two.

    Which triangle is nearest has no derivative, and the z-buffer takes seconds to compile.
    """
    del cull

    def look(screen: Any, faces: Any) -> Any:
        y, x = jnp.divmod(jnp.arange(height * width), width)
        pixel = jnp.stack([x, y], -1) + 0.5
        corner = screen[faces] - jnp.pad(pixel, ((0, 0), (0, 1)))[:, None, None]
        a, b, c = (corner[:, :, i] for i in range(3))
        areas = [p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0] for p, q in ((b, c), (c, a), (a, b))]
        total = areas[0] + areas[1] + areas[2]
        share = jnp.stack(areas, -1) / jnp.where(total == 0, 1.0, total)[..., None]
        depth = jnp.sum(share * corner[..., 2], -1)
        inside = jnp.all(share > 0, -1) & (total != 0) & jnp.all(corner[..., 2] > near, -1)
        found = jnp.argmin(jnp.where(inside, depth, jnp.inf), 1)
        return jnp.where(jnp.any(inside, 1), found, -1).reshape(height, width)

    return look


def on_screen(place: Any, depth: Any) -> Any:
    """Vertices as ``Camera.project`` gives them; px and mm are apart, as their sizes are."""
    return jnp.concatenate([place, depth[:, None]], axis=1)


def seen(place: Any, depth: Any) -> Any:
    """The bump rasterised."""
    return rasterize(on_screen(place, depth), model().faces, SIDE, SIDE)


def two_terms() -> energies.Energy:
    """A residual and a second one whose weights are data."""

    def first(args: Any) -> Any:
        return args[0]

    def second(args: Any) -> Any:
        return args[1]

    return compose([Term("a", lambda y, _: y, first), Term("b", lambda y, _: {"r": y**2}, second)])


def observed(y: Any, image: Any, mask: Any, data: FitInput, weights: FitWeights) -> Any:
    """The energy of a step, with all that the step chooses and weighs."""
    config = FitConfig(compared_pixels=60, curvature_pixels=20)
    modes = jnp.zeros((25, 3, 8))
    step = observe(y, image, mask, SIDE, data, fit_model(), modes, weights, config=config)
    return fit_energy().value(y, step)


def seen_level(photo: Any, weight: Any) -> SeenLevel:
    """All of it to be synthesised, a texel for half a pixel."""
    plain = jnp.ones_like(weight)
    return SeenLevel(photo, weight, photo, jnp.ones(weight.shape, bool), plain, 2.0)


def stages_visible(image: Any) -> Any:
    """The colours that are compared."""
    mask = jnp.ones((SIDE, SIDE))
    return visible_samples(parameters(), image, mask, SIDE, fit_input(), fit_model(), 60)


IRLS = "weights of the reweighting are constants of a step"
LEVEL = "the mipmap's level is held; test_unwrap takes differences where it is the finest"
VISIBLE = "what is visible, and which pixels count, is chosen and held"

simple("_numerics.above_rounding", above_rounding,
       lambda m: {"total": m.numbers(4, 3), "size": m.numbers(4)},
       singular="what is left over by rounding is cut, with its derivative")  # fmt: skip
simple("imaging.masks.smoothstep", smoothstep,
       lambda m: {"x": m.numbers(5), "start": jnp.array(0.1), "stop": jnp.array(0.9)})  # fmt: skip
simple("imaging.suv.remove_specular_peak", remove_specular_peak,
       lambda m: {"rgb": m.numbers(9, 10, 3), "source_colour": m.numbers(3)})  # fmt: skip
simple("imaging.mipmap.Mipmap.trilinear", Mipmap.trilinear, lambda m: {
    "self": pyramid(), "points": 8 * m.numbers(7, 2), "level": 3 * m.numbers(7) - 0.7})  # fmt: skip
simple(
    "render._rasterize.barycentrics",
    lambda place, depth: render.barycentrics(
        on_screen(place, depth), model().faces, seen(place, depth).triangle
    ),
    lambda m: {"place": screen()[:, :2], "depth": screen()[:, 2]},
)
simple("render._rasterize.rasterize", seen,
       lambda m: {"place": screen()[:, :2], "depth": screen()[:, 2]})  # fmt: skip
simple("render.image.render", sized(render.render),
       lambda m: {**scene(), "albedo": m.numbers(25, 3)})  # fmt: skip
simple("render.image.render_textured", sized(render.render_textured), lambda m: {
    **scene(), "texture": pyramid(), "uv": model().uv, "uv_faces": model().uv_faces,
    "occlusion": model().occlusion})  # fmt: skip
simple(
    "stages.fit.rendering.render_fit",
    functools.partial(stages.render_fit, size=SIDE),
    lambda m: {"y": parameters(), "model": fit_model(), "principal": jnp.array([0.5, 0.5])},
)
simple("stages._unwrap.unwrap", stages.unwrap, lambda m: {
    **{k: v for k, v in scene().items() if k != "pose"},
    "vertices": scene()["pose"](scene()["vertices"]), "photo": m.numbers(SIDE, SIDE, 3),
    "mask": jnp.ones((SIDE, SIDE)), "layout": layout(), "hidden": -0.1 * m.numbers(25, 3)},
    camera=LEVEL, layout=LEVEL, vertices=LEVEL)  # fmt: skip

simple("networks.texture_features.tiles.tile_of_map", lambda values: tile_of_map(
    values, "conv2_1", jnp.array([1, 0]), 4), lambda m: {"values": m.numbers(3, 3, 2)})  # fmt: skip
simple(
    "networks.texture_features.tiles.sum_over_tiles",
    lambda network, image: sum_over_tiles(
        lambda found, _: {k: v**2 for k, v in found.items()},
        network,
        image,
        ("conv1_1", "conv2_1"),
        4,
    ),
    lambda m: {"network": network(), "image": m.numbers(6, 7)},
)
simple("models.face_oval.face_oval", face_oval, lambda m: {"landmarks": m.numbers(68, 2)})
simple("models.skin.patch.patch_at", patch_at, lambda m: {
    "fields": m.make(SkinFields, "fields"), "base": m.numbers(25, 3), "faces": model().faces,
    "triangle": jnp.arange(7), "barycentric": 0.5 * m.numbers(7, 2), "resolution": 8})  # fmt: skip

simple("energies._gram.grams", functools.partial(energies.grams, layers=("conv1_1", "conv2_1")),
       lambda m: {"image": m.numbers(6, 7), "network": network()})  # fmt: skip
simple("energies._photometric_quadratic.photometric_jacobian", energies.photometric_jacobian,
       lambda m: {"y": parameters(), "model": model(), "samples": samples(),
                  "normal_modes": m.numbers(25, 3, 8)})  # fmt: skip
simple("energies._photometric_quadratic.photometric_quadratic", energies.photometric_quadratic,
       lambda m: {"y": parameters(), "data": energies.PhotometricData(model(), samples()),
                  "normal_modes": m.numbers(25, 3, 8)}, y=IRLS, data=IRLS)  # fmt: skip
simple("geometry.normal_stencil.normal_derivative", normal_derivative, lambda m: {
    "vertices": model().mean, "stencil": stencil(), "basis": m.numbers(25, 3, 2)})  # fmt: skip
simple("energies._photometric_quadratic.normal_modes", energies.normal_modes, lambda m: {
    "y": parameters(), "model": model(), "stencil": stencil()})  # fmt: skip
simple("energies.photometric.reweighting", energies.reweighting, lambda m: {
    "difference": m.numbers(5, 3), "weight": m.numbers(5)}, difference=IRLS)  # fmt: skip
simple("energies.photometric.photometric_residual", energies.photometric_residual, lambda m: {
    "y": parameters(), "data": energies.PhotometricData(model(), samples())},
    y=IRLS, data=IRLS)  # fmt: skip
simple("energies.term.Term.value", lambda y, weight: Term(
    "t", lambda y, weight: {"r": y**2}, lambda weight: weight).value(y, weight),
    lambda m: {"y": m.numbers(4), "weight": m.numbers()})  # fmt: skip
simple("energies.term.Energy.value", lambda y, args: two_terms().value(y, args),
       lambda m: {"y": m.numbers(4), "args": m.numbers(2)})  # fmt: skip
simple("energies.term.Energy.residual", lambda y, args: two_terms().residual(y, args),
       lambda m: {"y": m.numbers(4), "args": m.numbers(2)})  # fmt: skip
simple("energies.term.Energy.quadratic", lambda y, args: two_terms().quadratic(y, args)[0].value,
       lambda m: {"y": m.numbers(4), "args": m.numbers(2)})  # fmt: skip
simple("energies.term.sum_of_squares", energies.sum_of_squares,
       lambda m: {"tree": {"a": m.numbers(3), "b": m.numbers(2, 2)}})  # fmt: skip

simple("stages._common_light.lit_vertices", stages.lit_vertices, lambda m: {
    "y": parameters(), "model": model(), "image": m.numbers(SIDE, SIDE, 3),
    "mask": m.numbers(SIDE, SIDE), "principal": jnp.array([0.5, 0.5])})  # fmt: skip
simple("stages._common_light.common_light", functools.partial(stages.common_light, rounds=2),
       lambda m: {"photos": stages.LitVertices(m.numbers(2, 25, 3), m.numbers(2, 25, 9),
                                               m.numbers(2, 25)),
                  "mean": m.numbers(25, 3), "basis": 0.1 * m.numbers(25, 3, 2)},
       singular="gains of what has no colour are bounded by a tiny number")  # fmt: skip
simple("stages.fit._posterior.posterior", lambda root, model, weight: stages.posterior(
    root @ root.T + jnp.eye(len(root)), model, weight), lambda m: {
    "root": m.numbers(10, 10), "model": model(), "weight": m.numbers()})  # fmt: skip
simple("stages.fit.objective.fit_energy", lambda y, data: fit_energy().value(y, data),
       lambda m: {"y": parameters(), "data": fit_data()})  # fmt: skip
simple("stages.fit.solve.observe", observed, lambda m: {
    "y": parameters(), "image": m.numbers(SIDE, SIDE, 3), "mask": m.numbers(SIDE, SIDE),
    "data": fit_input(), "weights": fit_weights()},
    y=VISIBLE, image=VISIBLE, mask=VISIBLE, data=VISIBLE)  # fmt: skip
simple("stages.fit.visible.visible_samples", lambda image: stages_visible(image),
       lambda m: {"image": m.numbers(SIDE, SIDE, 3)})  # fmt: skip
simple(
    "stages.texture._synthesise.synthesis_energy",
    lambda image, problem: stages.synthesis_energy().value(image, problem),
    lambda m: {
        "image": m.numbers(6, 7),
        "problem": stages.SynthesisProblem(
            style().network,
            style().targets,
            m.numbers(6, 7) > 0.4,
            m.make(energies.KnownDetail, "known"),
            jax.tree.map(jnp.asarray, SynthesisWeights()),
        ),
    },
)

simple("geometry.rotation.rotation_matrices", rotation_matrices,
       lambda m: {"axis_angle": m.numbers(4, 3)})  # fmt: skip
simple("models.skin.pigments.Density.plus", lambda one, other: one.plus(other),
       lambda m: {"one": Density(*m.numbers(3, 4)), "other": Density(*m.numbers(3, 4))},
)  # fmt: skip

simple(
    "networks.texture_features.network.features",
    lambda network, image: features(network, image, ("conv1_1", "conv2_1")),
    lambda m: {"network": network(), "image": m.numbers(6, 7)},
)

simple(
    "geometry.nearest_rotation.rotation_change",
    rotation_change,
    lambda m: {"rotation": rotation_matrix(m.numbers(3)), "matrix": m.numbers(3, 3),
               "change": m.numbers(3, 3)},
    singular="zero is no rotation, and zero is near to no rotation",
)  # fmt: skip

simple(
    "stages.fit.start.initial_light",
    initial_light,
    lambda m: {"y": parameters(), "image": m.numbers(SIDE, SIDE, 3), "data": fit_input(),
               "mask": m.numbers(SIDE, SIDE), "model": fit_model()},
    singular="nothing of the face is seen: its mean colour is of no pixel",
)  # fmt: skip

simple(
    "energies.exemplar.exemplar_gram_residual",
    exemplar_gram_residual,
    lambda m: {"image": m.numbers(12, 13, 1), "args": exemplar()},
    singular="a flat picture lies on a kink of every ReLU",
)
simple("energies.term.Energy.total", lambda y, args: two_terms().total(y, args),
       lambda m: {"y": m.numbers(4), "args": m.numbers(2)})  # fmt: skip
simple("energies.term.Term.output", lambda y: Term(
    "t", lambda y, args: {"r": y**2}).output(y, None), lambda m: {"y": m.numbers(4)})  # fmt: skip
simple("stages.texture.composition.with_seen", lambda texture, photo, weight: with_seen(
    texture, seen_level(photo, weight)), lambda m: {
    "texture": m.numbers(SIDE, SIDE, 3), "photo": m.numbers(SIDE, SIDE, 3),
    "weight": m.numbers(SIDE, SIDE)})  # fmt: skip

WEIGHTS = {
    "ExemplarWeights": "energies.exemplar.exemplar_gram_residual",
    "FitWeights": "stages.fit.solve.observe",
    "SynthesisWeights": "stages.texture._synthesise.synthesis_energy",
}
"""records of weights, and the case that walks their fields"""

POSITIVE = (
    "focal", "texel", "unit", "deviation", "['stop']", "['args'][1]", "spacing", "['width']",
)  # fmt: skip
"""parts of the names of arguments that are positive by what they mean, and divided by"""

SLOW = {
    "render.image.render_textured",
    "stages._unwrap.unwrap",
    "energies._photometric_quadratic.photometric_jacobian",
    "energies._photometric_quadratic.photometric_quadratic",
}
"""what takes long to compile; rendering and unwrapping have tests of their own besides"""

NOT_DIFFERENTIABLE = {
    "by the implicit function theorem, against differences in test_fit and test_differentiable": [
        "stages.fit.batch.fit_batch",
        "stages.fit.levels.fit_parameters",
        "stages.fit.levels.through_levels",
        "stages.fit.levels.level_stages",
        "stages.fit.start.fit_start",
        "stages.fit.solve.fit_level",
        "stages.fit.start.fit_landmarks",
        "stages.fit.solve.fit_shadows",
    ],
    "by the implicit function theorem, against differences in test_blend": [
        "stages.blending.weights.blend_weights",
    ],
    "chains of layers that are walked, at 128 px and more; whole, in test_landmarks_net": [
        "networks.landmarks.face_detector.FaceDetector.__call__",
        "networks.landmarks.face_mesh.LandmarkNet.__call__",
        "networks.landmarks.face_mesh.landmarks_in_region",
        "networks.landmarks.face_mesh.symmetric_landmarks",
        "networks.landmarks.face_mesh.refine_landmarks",
    ],
    "paints a picture from hashed cells, with jumps between them; its traits are not fitted": [
        "models.skin.synthesis.synthesise_skin",
        "models.skin.furrows.furrows",
        "models.skin.hair.stubble",
        "models.skin.hair.brows",
        "models.skin.hair.scalp_roots",
        "models.skin.hair.down",
        "models.skin.lesions.freckles",
        "models.skin.lesions.marks",
        "models.skin.lips.lips",
        "models.skin.mottling.mottling",
        "models.skin.mottling.veins",
        "models.skin.noise.uniforms",
        "models.skin.noise.gradient_noise",
        "models.skin.noise.visible",
        "models.skin.noise.spectrum_noise",
        "models.skin.pores.pores",
        "models.skin.spots.gather_spots",
        "models.skin.spots.soft_disc",
        "models.skin.spots.stroke",
        "models.skin.spots.likely",
        "models.skin.wrinkles.wrinkles",
    ],
    "a choice that a step holds; its docstring says that no gradient passes": [
        "render._depth_buffer.depth_buffer",
        "render._depth_buffer.DepthBuffer.clear_of_contours",
        "render.occlusion.self_occlusion",
        "render.coverage.pixel_block",
        "render.coverage.inverse_depth_at",
        "stages.fit._cast_shadows.cast_shadows",
        "stages.fit.contour.slide_contour",
        "models.morphable.MorphableModel.region_mask",
        "networks.landmarks.face_detector.suppress",
        "models.face_oval.face_oval_mask",
    ],
    "with derivatives and differences of their own in test_exemplar": [
        "energies.exemplar.exemplar_targets",
        "energies.exemplar.octave_grams",
    ],
    "settings, no arrays": [
        "stages.fit.options.FitOptions.as_published",
        "stages.fit.options.FitOptions.changed",
        "stages.fit.options.FitOptions.config",
        "stages.fit.records.FitWeights.as_published",
        "stages.fit.records.FitWeights.from_text",
    ],
    "made on the host of a scan or of photos, in a search or by a choice among them": [
        "imaging.colour_axes.colour_axes",
        "stages._common_light.shared_light",
        "stages.scan._embed_landmarks.embed_landmarks",
        "stages.scan.transfer.own_parts",
        "stages.scan.transfer.whole_texture",
    ],
    "a target of the synthesis, which is held": ["stages.texture.statistics.nearest_positive"],
    "made on the host, once a model or a network": [
        "stages.fit.self_shadow.with_self_shadow",
        "geometry.uv.uv_layout",
        "models.subdivide.subdivide",
        "models.opening_rims.opening_rims",
        "models.skin.regions.skin_fields",
        "models.parameters.neutral_parameters",
        "networks.texture_features.network.prepare_kernels",
        "networks.convolution.conv3x3.prepared_kernel",
        "stages.fit.prepared.prepare",
        "stages.texture.masked_grams.cells.store",
    ],
    "drawn at random": ["models.skin.attributes.random_attributes"],
    "makes an energy, whose value is walked": [
        "energies.term.compose",
        "energies.term.quadratic_by_autodiff",
        "energies.term.Term.weight_at",
    ],
    "a loop on the host over an energy that is walked": [
        "stages.texture._synthesise.synthesise",
        "stages.texture._synthesise_texture.synthesise_texture",
    ],
    "an algorithm of the convolution, which has the derivative": [
        "networks.convolution.winograd.winograd_conv3x3",
    ],
    "gathers or casts records": [
        "models.parameters.set_apart",
        "stages.fit.objective.ExtraWeight.__call__",
        "stages.fit.objective.weights_as_data",
        "stages.fit.photo.in_units_of",
        "stages.fit.solve.landmarks_at",
        "stages.fit.solve.observe_finest",
        "stages.fit.solve.record_of",
        "stages.texture.composition.known_detail",
        "stages.fit.records.join_records",
        "stages.fit.prepared.in_precision_of",
    ],
}
"""reason -> names"""
