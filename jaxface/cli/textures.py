"""Commands of the texture: complete an albedo, and what that needs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table

from jaxface.cli import options
from jaxface.cli.console import console, errors, steps
from jaxface.cli.options import changed, with_options
from jaxface.pipeline.options import DigitizeOptions
from jaxface.pipeline.texture.options import CompletionOptions

database_app = typer.Typer(no_args_is_help=True, help="Texture databases: list, make, describe.")
features_app = typer.Typer(no_args_is_help=True, help="Feature networks of the texture statistics.")


FeaturesOption = Annotated[
    str, typer.Option("--features", help="random, trained, vgg16, vgg19, or a file of weights.")
]

_SOURCES = {name: options.TEXTURE[name] for name in ("database", "features")}


@with_options(CompletionOptions, "completion", options.COMPLETION)
@with_options(DigitizeOptions, "sources", _SOURCES)
def texture(
    out: Annotated[Path, typer.Argument(help="Folder that `jaxface digitize` or `fit` wrote.")],
    sources: Mapping[str, Any],
    completion: Mapping[str, Any],
    resolution: Annotated[
        int | None, typer.Option("--resolution", help="Texels along a side; as the partial albedo.")
    ] = None,
    model: Annotated[
        Path | None, typer.Option("--model", help="Model file, where it is not a bundled one.")
    ] = None,
    as_published: options.AsPublished = False,
) -> None:
    """Complete the albedo of a digitized photo: analysis, blending, synthesis."""
    from jaxface.pipeline import complete_folder

    with errors(), steps(f"texture of {out}") as on_step:
        asked = CompletionOptions.as_published() if as_published else CompletionOptions()
        done = complete_folder(
            out, **sources, resolution=resolution, model=model, on_step=on_step,
            options=changed(asked, options.COMPLETION, completion),
        )  # fmt: skip
    console.print(
        f"{(done.blended.weights > 0).sum()} subjects blended, relative gap "
        f"{float(done.blended.relative_gap):.1e}; wrote [bold]{out / 'albedo.png'}[/bold]"
    )
    if done.compared_by == "cache":
        console.print("compared by the statistics that `jaxface database precompute` keeps")


def synthesise(
    picture: Annotated[Path, typer.Argument(help="Picture of a texture, all of it.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="The PNG to write.")],
    features: FeaturesOption = DigitizeOptions.features,
    size: Annotated[
        str | None, typer.Option("--size", help="Side, or HEIGHTxWIDTH, px; as the picture's.")
    ] = None,
    layers: Annotated[
        str | None, typer.Option("--layers", help="As conv1_1,conv2_1; the first of each block.")
    ] = None,
    alpha: Annotated[float, typer.Option("--alpha", help="Weight of the Gram matrices.")] = 1.0,
    histogram: Annotated[
        float, typer.Option("--histogram", help="Weight of the distribution of colours.")
    ] = 0.1,
    octaves: Annotated[
        int, typer.Option("--octaves", help="Sizes at which the network sees the picture.")
    ] = 4,
    steps_: Annotated[int, typer.Option("--steps", help="Of the solver on each level.")] = 200,
    seed: Annotated[int, typer.Option("--seed", help="Of the noise at the start.")] = 0,
) -> None:
    """A new picture of a texture, of any size, from a picture of it."""
    from jaxface.pipeline.texture.exemplar import parse_size, synthesise_file

    with errors(), steps(str(picture)) as on_step:
        made = synthesise_file(
            picture, out, features=features, size=parse_size(size), alpha=alpha,
            layers=None if layers is None else tuple(layers.split(",")), histogram=histogram,
            octaves=octaves, steps=steps_, seed=seed,
            on_step=lambda done, of: on_step("steps", done, of),
        )  # fmt: skip
    first, last = made.values[-1][0], made.values[-1][-1]
    console.print(f"energy of the last level {first:.3g} to {last:.3g}; wrote [bold]{out}[/bold]")


@database_app.command("list")
def database_list() -> None:
    """Databases in the cache."""
    from jaxface.io.texture_database import cached_databases

    found = cached_databases()
    for path in found:
        print(path)
    if not found:
        console.print("none yet: `jaxface texture` makes the procedural one when it needs it")


@database_app.command("info")
def database_info(
    path: Annotated[Path, typer.Argument(help="Folder of a database.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """What a database holds: subjects, licences, size, gaps."""
    from jaxface.io.texture_database import TextureDatabase

    with errors():
        facts = TextureDatabase(path).info()
    if as_json:
        print(json.dumps(facts, indent=2))
        return
    table = Table(show_header=False)
    for key, value in facts.items():
        text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
        table.add_row(key, text)
    Console().print(table)


@database_app.command("synth")
def database_synth(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write into.")],
    subjects: Annotated[int, typer.Option("--subjects", help="How many.")] = 24,
    resolution: Annotated[int, typer.Option("--resolution", help="Texels along a side.")] = 1024,
    seed: Annotated[int, typer.Option("--seed", help="Of the population.")] = 0,
) -> None:
    """Procedural skins (CC0); goes on where an earlier run stopped."""
    from jaxface.pipeline.databases.painted import synth_database

    with errors(), steps(f"skins in {out}") as on_step:
        made: Any = synth_database(
            out, subjects, resolution, seed, lambda done, of: on_step("skins", done, of)
        )
    console.print(f"{len(made)} skins in [bold]{out}[/bold]")


@database_app.command("import-skins")
def database_import_skins(
    skins: Annotated[list[Path], typer.Argument(help="Textures painted for MakeHuman's UVs.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the database.")],
    resolution: Annotated[int, typer.Option("--resolution", help="Texels along a side.")] = 1024,
    licence: Annotated[str, typer.Option("--licence", help="Of the skins.")] = "CC0-1.0",
) -> None:
    """Bring MakeHuman skins into the default model's UVs."""
    from jaxface.pipeline.databases.makehuman import import_skins

    with errors(), steps(f"skins in {out}") as on_step:
        made: Any = import_skins(
            skins, out, resolution, licence=licence,
            on_progress=lambda done, of: on_step("skins", done, of),
        )  # fmt: skip
    console.print(f"{len(made)} textures in [bold]{out}[/bold]")


@database_app.command("import-scan")
def database_import_scan(
    mesh: Annotated[Path, typer.Argument(help="OBJ of a head, with texture coordinates.")],
    albedo: Annotated[Path, typer.Argument(help="Its colour map.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the database.")],
    licence: Annotated[str, typer.Option("--licence", help="Of the scan, with its credit.")],
    subject: Annotated[str | None, typer.Option("--subject", help="Name in the database.")] = None,
    landmarks: Annotated[
        Path | None, typer.Option("--landmarks", help="Points on the scan; detected if not given.")
    ] = None,
    resolution: Annotated[int, typer.Option("--resolution", help="Texels along a side.")] = 1024,
) -> None:
    """Register a head scan to the default topology and add its albedo to a database."""
    from jaxface.pipeline.databases.scan import import_scan

    with errors(), steps(str(mesh)) as on_step:
        import_scan(
            mesh, albedo, out, resolution, subject=subject or mesh.stem, licence=licence,
            landmarks=landmarks, on_progress=lambda done, of: on_step("registration", done, of),
        )  # fmt: skip
    console.print(f"wrote [bold]{out}[/bold]")


@database_app.command("transfer")
def database_transfer(
    model: Annotated[str, typer.Option("--model", help="Into whose UVs: a model file or name.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the database.")],
    database: Annotated[
        Path | None,
        typer.Option("--database", help="One in the bundled model's UVs; else procedural skins."),
    ] = None,
    resolution: Annotated[
        int | None, typer.Option("--resolution", help="Texels along a side; else the database's.")
    ] = None,
) -> None:
    """Carry textures over to another model by registration; goes on where it stopped."""
    from jaxface.pipeline.databases.transferred import transfer_database

    with errors(), steps(f"textures of {model}") as on_step:
        made: Any = transfer_database(model, out, database, resolution, on_progress=on_step)
    console.print(f"{len(made)} textures in [bold]{out}[/bold]; use it as `--database {out}`")


@database_app.command("build")
def database_build(
    photos: Annotated[Path, typer.Argument(help="Folder with one photo of each subject.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the database.")],
    licence: Annotated[
        str, typer.Option("--licence", help="What may be done with these people's textures.")
    ],
    resolution: Annotated[int, typer.Option("--resolution", help="Texels along a side.")] = 1024,
    credit: Annotated[
        list[str] | None, typer.Option("--credit", help="Line to print with results; repeatable.")
    ] = None,
    name: Annotated[
        str | None, typer.Option("--name", help="Of the database; the folder's if not given.")
    ] = None,
    model: Annotated[
        str, typer.Option("--model", help="In whose UVs the textures will be: name or file.")
    ] = "makehuman",
    size: Annotated[int, typer.Option("--size", help="Side of the fits' working image, px.")] = 512,
    common_light: Annotated[
        bool, typer.Option(help="Take the photos to be under one light, or each under its own.")
    ] = True,
    specularity: Annotated[
        bool, typer.Option("--remove-specularity/--keep-specularity", help="Gloss of the skin.")
    ] = True,
) -> None:
    """Albedo textures from a folder of photos; goes on where an earlier run stopped."""
    from jaxface.pipeline.databases.from_photos import build_database

    told: dict[str, str] = {}
    lost: set[str] = set()
    with errors(), steps(str(photos)) as on_step:

        def show(step: Any) -> None:
            on_step({"fit": "fits", "texture": "textures"}[step.stage], step.done, step.total)
            if step.problem is not None:
                told[step.photo.name] = step.problem
                if step.stage == "fit":
                    lost.add(step.photo.name)

        made = build_database(
            photos, out, resolution, licence=licence, credits=credit or (), name=name, model=model,
            size=size, common_light=common_light, remove_specularity=specularity, on_progress=show,
        )  # fmt: skip
    for problem in told.values():
        console.print(f"[yellow]{problem}[/yellow]", highlight=False, soft_wrap=True)
    console.print(f"{len(made)} textures in [bold]{out}[/bold]")
    if lost:
        raise typer.Exit(2)


@database_app.command("precompute")
def database_precompute(
    path: Annotated[Path, typer.Argument(help="Folder of a database.")],
    features: FeaturesOption = DigitizeOptions.features,
    resolution: Annotated[
        int | None,
        typer.Option("--resolution", help="Texels along a side; as photos are compared at."),
    ] = None,
    limit: Annotated[
        float, typer.Option("--limit", help="GB that the cache may hold; the oldest files go.")
    ] = 64,
) -> None:
    """Keep what makes comparing a photo with the textures fast; goes on where it stopped."""
    from jaxface.io.feature_weights import load_network
    from jaxface.io.texture_database import TextureDatabase
    from jaxface.pipeline.databases.grams import bytes_to_precompute, precompute
    from jaxface.pipeline.texture._complete import ANALYSIS

    with errors():
        database = TextureDatabase(path)
        side = min(ANALYSIS, database.resolution) if resolution is None else resolution
        network = load_network(features)
        size = bytes_to_precompute(database, network, side)
        console.print(f"{len(database)} textures of {side} texels take {size / 1e9:.3g} GB")
        with steps(f"statistics of {path}") as on_step:
            cache = precompute(
                database, network, side, lambda done, of: on_step("textures", done, of),
                maximum_bytes=round(limit * 1e9),
            )  # fmt: skip
    console.print(f"{len(cache.keys)} textures in [bold]{cache.files.path}[/bold]")


@features_app.command("info")
def features_info(
    source: Annotated[str, typer.Argument(help="random, trained, vgg16, vgg19, or a file.")],
) -> None:
    """Layers, channels and licence of a feature network."""
    from jaxface.io.feature_weights import load_network

    with errors():
        network = load_network(source)
    table = Table("layer", "channels", title=f"{network.name}, {network.pooling} pooling")
    for name, channels in network.channels.items():
        table.add_row(name, str(channels))
    Console().print(table)
    console.print(network.licence)


@features_app.command("train")
def features_train(
    out: Annotated[Path, typer.Option("--out", "-o", help="File of weights to write, .npz.")],
    images: Annotated[
        Path | None, typer.Argument(help="Folder of pictures; scikit-image's if not given.")
    ] = None,
    steps_: Annotated[int, typer.Option("--steps", help="Of the optimiser.")] = 300,
    seed: Annotated[int, typer.Option("--seed", help="Of the initial weights and crops.")] = 0,
) -> None:
    """Train a feature network without labels; goes on where an earlier run stopped."""
    from jaxface.pipeline.training.features import train_features

    with errors(), steps(f"features in {out}") as on_step:
        train_features(images, out, steps_, seed, on_step)
    console.print(f"wrote [bold]{out}[/bold]; use it as `--features {out}`")
