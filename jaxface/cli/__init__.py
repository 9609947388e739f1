"""The command line: parses, shows progress, calls the pipeline."""

import json
import sys
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from jaxface import __version__
from jaxface.cli import textures
from jaxface.cli.console import bar, console, errors, progress, steps
from jaxface.run.compile_cache import enable_compilation_cache
from jaxface.run.memory import keep_freed_memory

app = typer.Typer(
    name="jaxface", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    help="Fit a morphable face model to photos, with a gradient through every step.",
)  # fmt: skip
model_app = typer.Typer(no_args_is_help=True, help="Morphable models: list, describe, import.")
app.add_typer(model_app, name="model")
app.add_typer(textures.database_app, name="database")
app.add_typer(textures.features_app, name="features")
app.command("texture")(textures.texture)
app.command("synthesise")(textures.synthesise)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(__version__)
        raise typer.Exit


@app.callback()
def _command(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version."
        ),
    ] = False,
) -> None:
    """Options of the command itself, without a subcommand."""


PhotoArgument = Annotated[str, typer.Argument(help="Photo, folder of photos, or `demo`.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write into.")]
ModelOption = Annotated[
    str,
    typer.Option("--model", help="Bundled name or model file (.npz .mat .h5 .pkl .bin, folder)."),
]
LandmarksOption = Annotated[
    Path | None,
    typer.Option("--landmarks", help="Points to use instead of detection: .json, .pts or .txt."),
]
MaskOption = Annotated[
    Path | None, typer.Option("--mask", help="Image of the photo's size, white on face skin.")
]
FaceOption = Annotated[
    int | None,
    typer.Option("--face", help="Which face, from the largest (0), if there are several."),
]
LevelsOption = Annotated[
    str, typer.Option("--levels", help="Steps on each pyramid level, coarsest first.")
]
WeightsOption = Annotated[
    str | None,
    typer.Option(
        "--weights",
        help="Term weights that differ from the defaults, as photo=1,landmark=10,prior=2.5e-5.",
    ),
]
SizeOption = Annotated[int, typer.Option("--size", help="Side of the working image, px.")]
DetailsOption = Annotated[
    str | None,
    typer.Option("--details", help="Subdivisions of the model at each level, as 0,1,2."),
]
ShadowOption = Annotated[
    bool,
    typer.Option(help="Shade with what the face hides from itself of the light, or as the paper."),
]
ResolutionOption = Annotated[
    int, typer.Option("--resolution", help="Texels along a texture's side.")
]


@app.command()
def digitize(
    photo: PhotoArgument,
    out: OutOption,
    model: ModelOption = "makehuman",
    landmarks: LandmarksOption = None,
    mask: MaskOption = None,
    face: FaceOption = None,
    levels: LevelsOption = "30,10,3",
    weights: WeightsOption = None,
    size: SizeOption = 512,
    details: DetailsOption = None,
    self_shadow: ShadowOption = True,
    resolution: ResolutionOption = 2048,
    complete: Annotated[
        bool, typer.Option(help="Complete the albedo where the photo does not show it.")
    ] = True,
    database: textures.DatabaseOption = None,
    features: textures.FeaturesOption = "random",
    iterations: textures.IterationsOption = 1000,
) -> None:
    """The whole journey: fit a photo, complete its albedo, write mesh, maps and report."""
    from jaxface.pipeline.texture.folder import parse_settings

    options = _fit_options(model, landmarks, mask, face, levels, weights, size, details)
    options["self_shadow"] = self_shadow
    with errors():
        settings = parse_settings(iterations=iterations)
    _run(
        photo, out, with_texture=True, resolution=resolution, complete=complete, completion={
            "database": database, "features": features, "settings": settings
        }, **options,
    )  # fmt: skip


@app.command()
def fit(
    photo: PhotoArgument,
    out: OutOption,
    model: ModelOption = "makehuman",
    landmarks: LandmarksOption = None,
    mask: MaskOption = None,
    face: FaceOption = None,
    levels: LevelsOption = "30,10,3",
    weights: WeightsOption = None,
    size: SizeOption = 512,
    details: DetailsOption = None,
    self_shadow: ShadowOption = True,
) -> None:
    """The fit alone: mesh with vertex colours, coefficients, overlay and report."""
    options = _fit_options(model, landmarks, mask, face, levels, weights, size, details)
    options["self_shadow"] = self_shadow
    _run(photo, out, with_texture=False, **options)


@app.command()
def landmarks(
    photo: PhotoArgument,
    out: OutOption,
    scheme: Annotated[
        str, typer.Option(help="mediapipe468 or ibug68, of the files to write.")
    ] = "mediapipe468",
) -> None:
    """Detect faces and their landmarks: JSON and .pts for each face, and a picture."""
    from jaxface.pipeline.fitting.detection import write_detections

    with errors(), progress(f"landmarks of {photo}"):
        count = write_detections(photo, out, scheme)
    console.print(f"{count} face{'s' * (count != 1)}; wrote [bold]{out}[/bold]")


@model_app.command("list")
def model_list() -> None:
    """Models that come with the package, and formats that can be read."""
    from jaxface.io.face_models.model_file import bundled_models

    for name in bundled_models():
        print(name)
    console.print(
        "files: .npz (jaxface, FLAME, ICT-FaceKit), .mat (BFM 2009), .h5 (BFM 2017, 2019), "
        ".pkl (FLAME), .bin (Surrey), folder (ICT-FaceKit)"
    )


@model_app.command("info")
def model_info(
    model: Annotated[str, typer.Argument(help="Bundled name or model file.")] = "makehuman",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """What a model holds: sizes, modes, landmarks, regions, licence."""
    from jaxface.io.face_models import describe, load_model

    with errors():
        facts = describe(load_model(model))
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    table = Table(show_header=False)
    for key, value in facts.items():
        text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        table.add_row(key.replace("_", " "), text)
    Console().print(table)


@model_app.command("import")
def model_import(
    source: Annotated[str, typer.Argument(help="Model file or folder.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The .npz to write.")],
    points: Annotated[
        Path | None, typer.Option("--landmarks", help="68 correspondences, for formats without.")
    ] = None,
) -> None:
    """Convert a model of another format into this package's own file."""
    from jaxface.io.face_models import describe, load_model
    from jaxface.io.face_models.model_file import save_model

    options = {} if points is None else {"landmarks": points}
    with errors(), progress(f"importing {source}"):
        model = load_model(source, **options)
        save_model(out, model)
    facts = describe(model)
    console.print(
        f"wrote [bold]{out}[/bold]: {facts['vertices']} vertices, "
        f"{facts['identity_modes']} identity, {facts['expression_modes']} expression and "
        f"{facts['albedo_modes']} albedo modes"
    )
    if not (facts["landmarks68"] or facts["landmarks468"]):
        console.print("it has no landmark correspondences yet: jaxface model embed-landmarks")


@model_app.command("embed-landmarks")
def model_embed_landmarks(
    source: Annotated[str, typer.Argument(help="Bundled name, model file or folder.")],
    out: OutOption,
) -> None:
    """Find a model's landmark correspondences by rendering it and running the detector."""
    from jaxface.pipeline.databases.embedding import embed_landmarks_of

    with errors(), progress(f"landmarks of {source}"):
        facts = embed_landmarks_of(source, out)
    console.print(
        f"wrote [bold]{out}[/bold]: found in {facts['views']} views, median spread "
        f"{facts['median_spread_mm']:.2f} mm; check landmarks.png"
    )


def _fit_options(
    model: str,
    landmarks: Path | None,
    mask: Path | None,
    face: int | None,
    levels: str,
    weights: str | None,
    size: int,
    details: str | None,
) -> dict[str, Any]:
    with errors():
        options: dict[str, Any] = {
            "model": model,
            "landmarks_file": landmarks,
            "mask_file": mask,
            "face": face,
            "steps": _integers("--levels", levels),
            "size": size,
        }
        if details is not None:
            options["details"] = _integers("--details", details)
        if weights is not None:
            from jaxface.pipeline.fitting._fit import parse_weights

            options["weights"] = parse_weights(weights)
    return options


def _integers(option: str, text: str) -> tuple[int, ...]:
    try:
        return tuple(int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} is {text!r}; whole numbers and commas are needed") from None


def _run(photo: str, out: Path, **options: Any) -> None:
    if photo != "demo" and Path(photo).is_dir():
        _run_folder(Path(photo), out, **options)
        return
    from jaxface.pipeline import digitize as run

    with errors(), steps(str(photo)) as on_step:
        fitted = run(photo, out, on_step=on_step, **options)
    console.print(
        f"landmark error {fitted.landmark_error():.1%} of the eye distance; "
        f"open [bold]{out / 'report.html'}[/bold]"
    )


def _run_folder(folder: Path, out: Path, **options: Any) -> None:
    from jaxface.pipeline import digitize_folder, photos_in

    failed = 0
    with errors():
        photos = photos_in(folder)
        with bar() as shown:
            task = shown.add_task("photos", total=len(photos))
            for entry in digitize_folder(photos, out, **options):
                shown.advance(task)
                if entry.error is not None:
                    failed += 1
                    console.print(f"[red]{entry.photo.name}[/red]: {entry.error}")
                elif entry.fitted is None:
                    console.print(f"{entry.photo.name}: done before")
    console.print(f"{len(photos) - failed} of {len(photos)} photos in [bold]{out}[/bold]")
    if failed:
        raise typer.Exit(2)


def main() -> None:
    """Entry point of the ``jaxface`` command."""
    keep_freed_memory()
    enable_compilation_cache()
    app()


if __name__ == "__main__":
    sys.exit(main())
