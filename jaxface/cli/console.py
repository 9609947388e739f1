"""What the commands show: progress while they work, errors in one line."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

console = Console(stderr=True)


def bar() -> Progress:
    """Progress with a spinner, for work whose length is not known."""
    return Progress(
        SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=console,
        transient=True,
    )  # fmt: skip


@contextmanager
def progress(text: str) -> Iterator[None]:
    """A spinner beside a text."""
    with bar() as shown:
        shown.add_task(text, total=None)
        yield


@contextmanager
def errors() -> Iterator[None]:
    """What a user can mend is told in one line, with exit code 2 and no traceback.

    What a user should know is told in one line too, and the work goes on.
    """
    try:
        with warnings.catch_warnings():
            warnings.showwarning = _told
            yield
    except (ValueError, FileNotFoundError, IsADirectoryError, PermissionError) as error:
        _tell("[bold red]error:[/bold red]", str(error))
        raise typer.Exit(2) from error


def _told(message: Warning | str, category: type[Warning], *place: object, **more: object) -> None:
    text = str(message) if category is UserWarning else f"{category.__name__}: {message}"
    _tell("[bold yellow]warning:[/bold yellow]", text)


def _tell(kind: str, text: str) -> None:
    # Square brackets of a message are its own, not markup.
    console.print(f"{kind} {escape(text)}", highlight=False, soft_wrap=True)


@contextmanager
def steps(text: str) -> Iterator[Callable[[str, int, int], None]]:
    """A bar for each kind of work, moved by ``(what, done, of)``."""
    columns = SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(*columns, TimeElapsedColumn(), console=console) as shown:
        tasks = {text: shown.add_task(text, total=None)}

        def move(what: str, done: int, of: int) -> None:
            if what not in tasks:
                tasks[what] = shown.add_task(what, total=of)
            shown.update(tasks[what], completed=done, total=of)

        yield move
        shown.update(tasks[text], total=1, completed=1)
