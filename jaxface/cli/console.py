"""What the commands show: progress while they work, errors in one line."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)

from jaxface.cli.progress_lines import ProgressLines, beating

console = Console(stderr=True)
_AS_IT_IS: Any = {"highlight": False, "soft_wrap": True}


@contextmanager
def progress(text: str) -> Iterator[None]:
    """A text, and that the work goes on: for work whose length is not known."""
    with _spinner(text) if _is_live() else _lines(text):
        yield


class Steps(Protocol):
    """Progress that is shown."""

    def __call__(self, what: str, done: int, of: int) -> None:
        """News of a kind of work."""
        ...

    def say(self, text: str) -> None:
        """What is being done now."""
        ...


@contextmanager
def steps(text: str) -> Iterator[Steps]:
    """Progress of each kind of work, moved by ``(what, done, of)``.

    On a terminal a bar for each and a spinner beside the text; elsewhere, in a log or a job queue,
    `ProgressLines`.
    """
    with _bars(text) if _is_live() else _lines(text) as shown:
        yield shown


def _is_live() -> bool:
    # Rich takes a file for a terminal where the environment asks for colours; a bar needs one.
    return console.is_interactive and console.file.isatty()


@contextmanager
def _spinner(text: str) -> Iterator[None]:
    columns = SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as shown:
        shown.add_task(escape(text), total=None)
        yield


class _Bars:
    def __init__(self, shown: Progress, text: str) -> None:
        self._shown, self._text = shown, text
        self._whole = shown.add_task(escape(text), total=None)
        self._tasks: dict[str, TaskID] = {}
        self._done: dict[str, int] = {}

    def __call__(self, what: str, done: int, of: int) -> None:
        if what not in self._tasks:
            self._tasks[what] = self._shown.add_task(escape(what), total=of)
        elif done < self._done[what]:  # the next photo's
            self._shown.reset(self._tasks[what])
        self._done[what] = done
        self._shown.update(self._tasks[what], completed=done, total=of)

    def say(self, text: str) -> None:
        self._shown.update(self._whole, description=escape(f"{self._text}: {text}"))

    def end(self) -> None:
        self._shown.update(self._whole, description=escape(self._text), total=1, completed=1)


@contextmanager
def _bars(text: str) -> Iterator[Steps]:
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeElapsedColumn(), console=console) as shown:
        bars = _Bars(shown, text)
        yield bars
        bars.end()


@contextmanager
def _lines(text: str) -> Iterator[Steps]:
    lines = ProgressLines(lambda line: console.print(line, markup=False, **_AS_IT_IS))
    lines.say(text)
    with beating(lines):
        yield lines
    lines.say(f"{text}: done")


def tell(name: str, text: str, wrong: bool = False) -> None:
    """A line about one thing by its name, in red if something is wrong with it."""
    name = escape(name)
    _tell(f"[red]{name}[/red]:" if wrong else f"{name}:", text)


@contextmanager
def errors() -> Iterator[None]:
    """What a user can mend is told in one line, with exit code 2 and no traceback.

    What a user should know is told in one line too, and the work goes on.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _told
            yield
    except (
        ValueError,
        FileNotFoundError,
        IsADirectoryError,
        NotADirectoryError,
        PermissionError,
        ModuleNotFoundError,
    ) as error:
        _tell("[bold red]error:[/bold red]", str(error))
        raise typer.Exit(2) from error


def _told(message: Warning | str, category: type[Warning], *place: object, **more: object) -> None:
    text = str(message) if category is UserWarning else f"{category.__name__}: {message}"
    _tell("[bold yellow]warning:[/bold yellow]", text)


def _tell(kind: str, text: str) -> None:
    # Square brackets of a message are its own, not markup.
    console.print(f"{kind} {escape(text)}", **_AS_IT_IS)
