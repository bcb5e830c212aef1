"""What a command shows while it works and says nothing: what it does, and for how long already."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Lock, Timer
from time import monotonic
from typing import Any, Final

PATIENCE_S: Final = 1.0
"""How long nobody wonders."""


class Waiting:
    """A line on standard error from `PATIENCE_S` on, which goes when the work is done."""

    def __init__(self, what: str) -> None:
        """Begin to wait for `what`, as in "fitting"."""
        self._what, self._lock, self._over = what, Lock(), False
        self._line: Any = None
        self._task: Any = None
        self._began = monotonic()
        self._timer = Timer(PATIENCE_S, self._show)
        self._timer.daemon = True
        self._timer.start()

    def _show(self) -> None:
        from rich.console import Console
        from rich.markup import escape
        from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        line = Progress(
            SpinnerColumn("line"),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            transient=True,
        )
        task = line.add_task(escape(self._what), total=None)
        line.tasks[task].start_time = self._began
        with self._lock:
            if not self._over:
                self._line, self._task = line, task
                line.update(task, description=escape(self._what))
                line.start()

    def say(self, what: str) -> None:
        """Say what is being done now."""
        from rich.markup import escape

        with self._lock:
            self._what = what
            if self._line is not None:
                self._line.update(self._task, description=escape(what))

    def close(self) -> None:
        """Take the line away."""
        self._timer.cancel()
        with self._lock:
            self._over = True
            if self._line is not None:
                self._line.stop()


@contextmanager
def waiting(what: str) -> Iterator[Callable[[str], None]]:
    """Show on a terminal that the block is still at work; elsewhere nothing, and nothing where it is quick.

    The block prints nothing: what it found is printed after it. What this yields says what is being done now.
    """
    if not sys.stderr.isatty():
        yield lambda _what: None
        return
    line = Waiting(what)
    try:
        yield line.say
    finally:
        line.close()
