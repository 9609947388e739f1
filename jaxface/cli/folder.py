"""A folder of photos on the command line: options, what is told of each photo, exit code."""

from collections import Counter
from pathlib import Path
from typing import Annotated

import typer

from jaxface.cli.console import console, errors, steps, tell
from jaxface.pipeline.options import DigitizeOptions

ShardOption = Annotated[
    str | None,
    typer.Option("--shard", help="K/N: of a folder the K-th of N equal parts alone, as 3/8."),
]
SchedulerOption = Annotated[
    str | None,
    typer.Option(
        "--scheduler",
        help="Share a folder among the workers of a dask.distributed scheduler: address or file.",
    ),
]

_STATES = {"written": "done", "present": "done before", "taken": "another process is at it"}


def digitize_photos(
    folder: Path, out: Path, asked: DigitizeOptions, shard: str | None, scheduler: str | None
) -> None:
    """Digitize a folder, here or over a scheduler; exit code 2 if a photo fails.

    Args:
        folder: of the photos.
        out: for a folder of results for each.
        asked: the settings.
        shard: of the photos, or None for all.
        scheduler: of dask.distributed, or None for this process.
    """
    from jaxface.pipeline import digitize_folder, digitize_on_cluster, photos_in, shard_of

    found: Counter[str] = Counter()
    with errors():
        photos = photos_in(folder)
        photos = photos if shard is None else shard_of(photos, shard)
        with steps(str(folder)) as on_step:
            if scheduler is not None:
                entries = digitize_on_cluster(photos, out, scheduler, asked)
            else:
                entries = digitize_folder(
                    photos, out, asked,
                    on_start=lambda photo: on_step.say(photo.name), on_step=on_step,
                )  # fmt: skip
            for number, entry in enumerate(entries, 1):
                found[entry.state] += 1
                text = _STATES.get(entry.state) or entry.error or entry.state
                tell(entry.photo.name, text, wrong=entry.error is not None)
                on_step("photos", number, len(photos))
    whole = found["written"] + found["present"]
    console.print(f"{whole} of {len(photos)} photos in [bold]{out}[/bold]")
    if found["failed"]:
        raise typer.Exit(2)
