"""Progress as plain lines, for a log or a job queue, where no bar can move."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

LINE_EVERY = 5.0
"""seconds between two lines of work that goes on, at least"""

BEAT_EVERY = 20.0
"""seconds of silence after which a line says that the work goes on"""


class ProgressLines:
    """Lines as ``0:03:41 synthesis 512 px 12/60``: time since the start, what, how far.

    Each kind of work has a line when it begins and one when it ends, and those between come every
    few seconds at most; a `beat` that finds a long silence says what is being done. Safe to call
    from several threads.
    """

    def __init__(
        self,
        tell: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
        line_every: float = LINE_EVERY,
        beat_every: float = BEAT_EVERY,
    ) -> None:
        """Begin; nothing is told yet.

        Args:
            tell: is given each line.
            clock: seconds, from any start.
            line_every: see `LINE_EVERY`.
            beat_every: see `BEAT_EVERY`.
        """
        self._tell, self._clock = tell, clock
        self._line_every, self._beat_every = line_every, beat_every
        self._start = self._last = clock()
        self._doing = ""
        self._done: dict[str, int] = {}
        self._lock = threading.Lock()

    def say(self, text: str) -> None:
        """A line at once; until the next news it is also what is being done."""
        with self._lock:
            self._doing = text
            self._line(text)

    def __call__(self, what: str, done: int, of: int) -> None:
        """News of a kind of work; one that falls back has begun anew."""
        with self._lock:
            before = self._done.get(what)
            self._done[what] = done
            begins = before is None or done < before
            ends = done >= of and done != before
            news = f"{what} {done}/{of}"
            self._doing = f"after {news}" if done >= of else news
            if begins or ends or self._clock() - self._last >= self._line_every:
                self._line(news)

    def beat(self) -> None:
        """Say what is being done, unless something was said a moment ago."""
        with self._lock:
            if self._clock() - self._last >= self._beat_every:
                self._line(f"{self._doing} ...")

    def _line(self, text: str) -> None:
        self._last = self._clock()
        seconds = int(self._last - self._start)
        clock = f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
        self._tell(f"{clock} {text}")


@contextmanager
def beating(lines: ProgressLines, look_every: float = 1.0) -> Iterator[None]:
    """Let a thread call `ProgressLines.beat` during the body; it ends with the body.

    Args:
        lines: whose.
        look_every: seconds between two calls.

    Yields:
        Nothing.
    """
    over = threading.Event()

    def beats() -> None:
        while not over.wait(look_every):
            lines.beat()

    # A daemon, so that a process that is ended from without does not wait for it.
    thread = threading.Thread(target=beats, name="jaxface-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
