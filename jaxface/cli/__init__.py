"""The command line: parses, shows progress, calls the pipeline."""

import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from jaxface import __version__
from jaxface.cli import folder, options, textures
from jaxface.cli.console import console, errors, progress, steps
from jaxface.cli.options import changed, with_options
from jaxface.pipeline import FitOptions
from jaxface.pipeline.options import DigitizeOptions
from jaxface.pipeline.texture.options import CompletionOptions
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


@app.command()
@with_options(DigitizeOptions, "texture", options.TEXTURE)
@with_options(CompletionOptions, "completion", options.COMPLETION)
@with_options(FitOptions, "fitting", options.FIT)
@with_options(DigitizeOptions, "journey", options.JOURNEY)
def digitize(
    photo: PhotoArgument,
    out: OutOption,
    journey: Mapping[str, Any],
    fitting: Mapping[str, Any],
    completion: Mapping[str, Any],
    texture: Mapping[str, Any],
    as_published: options.AsPublished = False,
    shard: folder.ShardOption = None,
    scheduler: folder.SchedulerOption = None,
) -> None:
    """The whole journey: fit a photo, complete its albedo, write mesh, maps and report."""
    with errors():
        asked = DigitizeOptions.as_published() if as_published else DigitizeOptions()
        asked = replace(
            asked,
            fit=changed(asked.fit, options.FIT, fitting),
            completion=changed(asked.completion, options.COMPLETION, completion),
        )
        asked = changed(asked, {**options.JOURNEY, **options.TEXTURE}, {**journey, **texture})
    _run(photo, out, asked, shard, scheduler)


@app.command()
@with_options(FitOptions, "fitting", options.FIT)
@with_options(DigitizeOptions, "journey", options.JOURNEY)
def fit(
    photo: PhotoArgument,
    out: OutOption,
    journey: Mapping[str, Any],
    fitting: Mapping[str, Any],
    as_published: options.AsPublished = False,
    shard: folder.ShardOption = None,
    scheduler: folder.SchedulerOption = None,
) -> None:
    """The fit alone: mesh with vertex colours, coefficients, overlay and report."""
    with errors():
        asked = FitOptions.as_published() if as_published else FitOptions()
        asked = DigitizeOptions(fit=changed(asked, options.FIT, fitting), with_texture=False)
        asked = changed(asked, options.JOURNEY, journey)
    _run(photo, out, asked, shard, scheduler)


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


def _run(
    photo: str, out: Path, asked: DigitizeOptions, shard: str | None, scheduler: str | None
) -> None:
    if photo != "demo" and Path(photo).is_dir():
        folder.digitize_photos(Path(photo), out, asked, shard, scheduler)
        return
    from jaxface.pipeline import digitize as run

    with errors():
        if shard or scheduler:
            raise ValueError(f"--shard and --scheduler need a folder of photos; {photo} is none")
        with steps(str(photo)) as on_step:
            fitted = run(photo, out, asked, on_step=on_step)
    console.print(
        f"landmark error {fitted.landmark_error():.1%} of the eye distance; "
        f"open [bold]{out / 'report.html'}[/bold]"
    )


def main() -> None:
    """Entry point of the ``jaxface`` command."""
    keep_freed_memory()
    enable_compilation_cache()
    app()


if __name__ == "__main__":
    sys.exit(main())
