"""Progress: a bar on a terminal, plain lines elsewhere; by a clock of the test's own."""

import functools
import importlib
import io
import threading

import pytest
from rich.console import Console

from jaxface.cli.console import progress, steps
from jaxface.cli.progress_lines import ProgressLines, beating

shown = importlib.import_module("jaxface.cli.console")  # the package has its console by this name


class Clock:
    """A clock that stands until it is moved."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def clock():
    return Clock()


def console_of(file: io.StringIO, monkeypatch, **given) -> io.StringIO:
    monkeypatch.setattr(shown, "console", Console(file=file, **given))
    return file


def test_lines_come_at_the_start_at_the_end_and_every_few_seconds_between(clock):
    told = []
    lines = ProgressLines(told.append, clock, line_every=5.0)
    for done in range(1, 101):
        lines("skins", done, 100)
        clock.now += 0.3
    assert told[0] == "0:00:00 skins 1/100" and told[-1] == "0:00:29 skins 100/100"
    assert told[1:-1] == [f"0:00:{t:02d} skins {n}/100" for t, n in [
        (5, 18), (10, 35), (15, 52), (20, 69), (25, 86),
    ]]  # fmt: skip


def test_each_kind_of_work_begins_and_ends_with_a_line(clock):
    told = []
    lines = ProgressLines(told.append, clock)
    clock.now += 3671
    for what in ("compare", "synthesis [256]"):
        for done in (1, 2, 3):
            lines(what, done, 3)
        lines(what, 3, 3)
    lines("compare", 1, 3)  # the next photo's
    assert told == [
        "1:01:11 compare 1/3", "1:01:11 compare 3/3", "1:01:11 synthesis [256] 1/3",
        "1:01:11 synthesis [256] 3/3", "1:01:11 compare 1/3",
    ]  # fmt: skip


def test_silence_is_broken_by_what_is_being_done(clock):
    told = []
    lines = ProgressLines(told.append, clock, beat_every=20.0)
    lines.say("demo")
    for _ in range(45):
        clock.now += 1
        lines.beat()
    assert told == ["0:00:00 demo", "0:00:20 demo ...", "0:00:40 demo ..."]
    lines("skins", 1, 2)
    for _ in range(3):
        clock.now += 15
        lines.beat()
    lines("skins", 2, 2)
    clock.now += 20
    lines.beat()
    assert told[3:] == [
        "0:00:45 skins 1/2", "0:01:15 skins 1/2 ...", "0:01:30 skins 2/2",
        "0:01:50 after skins 2/2 ...",
    ]  # fmt: skip


def test_the_beat_ends_with_the_work(clock):
    told, spoken = [], threading.Event()

    def tell(line: str) -> None:
        told.append(line)
        if len(told) == 2:
            spoken.set()

    lines = ProgressLines(tell, clock, beat_every=0.0)
    with pytest.raises(ValueError), beating(lines, look_every=1e-3):
        lines.say("work")
        spoken.wait()  # for the thread, however slow
        raise ValueError
    count = len(told)
    assert told[1] == "0:00:00 work ..."
    assert not [t for t in threading.enumerate() if t.name == "jaxface-progress"]
    assert len(told) == count


@pytest.mark.parametrize("colours", [False, True])
def test_a_log_gets_plain_lines(monkeypatch, clock, colours):
    """Also where the environment asks for colours, which makes rich take it for a terminal."""
    log = console_of(io.StringIO(), monkeypatch, force_terminal=colours or None, width=40)
    monkeypatch.setattr(shown, "ProgressLines", functools.partial(ProgressLines, clock=clock))
    with steps("photos of [summer]/a very long name of a folder, longer than a line") as move:
        move("compare [1]", 1, 2)
        move("compare [1]", 2, 2)
    with progress("import"):
        pass
    assert log.getvalue().splitlines() == [
        "0:00:00 photos of [summer]/a very long name of a folder, longer than a line",
        "0:00:00 compare [1] 1/2",
        "0:00:00 compare [1] 2/2",
        "0:00:00 photos of [summer]/a very long name of a folder, longer than a line: done",
        "0:00:00 import",
        "0:00:00 import: done",
    ]


def test_work_that_fails_is_not_called_done(monkeypatch, clock):
    log = console_of(io.StringIO(), monkeypatch)
    monkeypatch.setattr(shown, "ProgressLines", functools.partial(ProgressLines, clock=clock))
    with pytest.raises(ValueError), steps("work"):
        raise ValueError
    assert log.getvalue().splitlines() == ["0:00:00 work"]


def test_a_terminal_gets_bars(monkeypatch):
    screen = console_of(Terminal(), monkeypatch, force_terminal=True, width=100)
    with steps("photo [1]") as move:
        move("compare", 1, 4)
        move("compare", 4, 4)
        move.say("b.png [2]")
        move("compare", 2, 4)
    text = screen.getvalue()
    assert (
        "photo [1]" in text
        and "b.png [2]" in text
        and "compare" in text
        and "2/4" in text
        and "\x1b[" in text
    )
    with progress("import"):
        pass
    assert "import" in screen.getvalue() and "import: done" not in screen.getvalue()
