"""Options of the command line, made from the records that the pipeline takes."""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from jaxface.pipeline import FitOptions, FitWeights
from jaxface.pipeline.options import DigitizeOptions
from jaxface.pipeline.texture.options import CompletionOptions, parse_detail


class Flag(NamedTuple):
    """How a field of a record stands on the command line.

    Attributes:
        name: of the option; both, with a slash, of a switch.
        kind: its type there.
        read: from that type to the field's; None: as it is.
        shown: the default as text; None: as it is.
        said: help, where the field's own does not fit text.
    """

    name: str
    kind: Any = str
    read: Callable[[Any], Any] | None = None
    shown: str | None = None
    said: str | None = None


def integers(option: str) -> Callable[[str], tuple[int, ...]]:
    """A reader of ``1,2,3``."""

    def read(text: str) -> tuple[int, ...]:
        try:
            return tuple(int(part) for part in text.split(","))
        except ValueError:
            raise ValueError(f"{option} is {text!r}; whole numbers and commas are needed") from None

    return read


def names(text: str) -> tuple[str, ...]:
    """``a,b`` as a tuple."""
    return tuple(part.strip() for part in text.split(","))


FIT = {
    "face": Flag("--face", int, None, "the only one"),
    "steps": Flag("--levels", str, integers("--levels"), ",".join(map(str, FitOptions().steps))),
    "weights": Flag(
        "--weights", str, FitWeights.from_text, "see docs/energies.md",
        "Term weights that differ from the defaults, as photo=1,landmark=10,prior=2.5e-5.",
    ),
    "size": Flag("--size", int),
    "details": Flag("--details", str, integers("--details"), "by the model"),
    "focal": Flag("--focal", float, None, "the file's"),
    "freeze": Flag(
        "--freeze", str, names, "nothing",
        "Unknowns that stay as they are at the start, as expression,albedo.",
    ),
    "self_shadow": Flag("--self-shadow/--no-self-shadow", bool),
}  # fmt: skip

COMPLETION = {
    "iterations": Flag("--iterations", int),
    "alpha": Flag("--alpha", float),
    "norm": Flag("--norm"),
    "detail": Flag("--detail", str, parse_detail, "1 everywhere"),
    "keep_photo": Flag("--keep-photo", float),
    "start": Flag("--start"),
}

JOURNEY = {
    "model": Flag("--model"),
    "landmarks": Flag("--landmarks", Path, None, "detected"),
    "mask": Flag("--mask", Path, None, "found"),
}

TEXTURE = {
    "resolution": Flag("--resolution", int),
    "complete": Flag("--complete/--no-complete", bool),
    "database": Flag("--database", Path, None, "procedural skins"),
    "features": Flag("--features"),
}

AsPublished = Annotated[
    bool,
    typer.Option("--as-published", help="Saito 2017 as printed: every departure switched off."),
]


def with_options(
    record: type[FitOptions] | type[CompletionOptions] | type[DigitizeOptions],
    argument: str,
    flags: Mapping[str, Flag],
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """A decorator that gives a command an option for each field named.

    Defaults and helps are the record's own. The command gets a mapping of the fields that were
    given, by name, so that they may change any record.

    Args:
        record: the record.
        argument: of the command, which gets the mapping.
        flags: by name of the field.
    """
    fields = {part.name: part for part in dataclasses.fields(record)}
    usual = record()

    def decorate(command: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(command)
        own = [p for p in signature.parameters.values() if p.name != argument]

        @functools.wraps(command)
        def run(**given: Any) -> None:
            changes = {}
            for name in flags:
                value = given.pop(f"{argument}_{name}")
                if value is not None:
                    changes[name] = value
            command(**given, **{argument: changes})

        added = [
            inspect.Parameter(
                f"{argument}_{name}",
                inspect.Parameter.KEYWORD_ONLY,
                default=None,
                annotation=Annotated[
                    flag.kind | None,
                    typer.Option(
                        flag.name,
                        help=flag.said or fields[name].metadata.get("help"),
                        show_default=flag.shown or str(getattr(usual, name)),
                    ),
                ],
            )
            for name, flag in flags.items()
        ]
        own = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in own]
        run.__signature__ = signature.replace(parameters=[*own, *added])  # pyright: ignore
        run.__annotations__ = {p.name: p.annotation for p in [*own, *added]}
        return run

    return decorate


def changed(record: Any, flags: Mapping[str, Flag], given: Mapping[str, Any]) -> Any:
    """A record with the fields that were given, read from the command line's text.

    Raises:
        ValueError: a text cannot be read, or a value does not fit.
    """
    values = {}
    for name, value in given.items():
        read = flags[name].read
        values[name] = value if read is None else read(value)
    return dataclasses.replace(record, **values)
