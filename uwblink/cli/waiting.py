"""The line that a command shows on a terminal while it works: what it does, and for how long already."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from time import monotonic


@contextmanager
def waiting(what: str, *, after_s: float = 1.0) -> Iterator[Callable[[str], object]]:
    """Show on a terminal what the block does, as in "fitting", if it takes longer than `after_s` seconds.

    Nothing is shown elsewhere, and the line is gone after the block, which must not print. Yields a function that
    replaces the text.
    """
    if not sys.stderr.isatty():
        yield lambda _what: None
        return
    texts, done = [what], Event()
    line = Thread(target=_show, args=(texts, done, after_s, monotonic()), daemon=True)
    line.start()
    try:
        yield texts.append
    finally:
        done.set()
        line.join()


def _show(texts: list[str], done: Event, after_s: float, began_s: float) -> None:
    """Show the last of the texts until the work is done."""
    if done.wait(after_s):
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn("line"), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as line:
        task = line.add_task(escape(texts[-1]), total=None)
        line.tasks[task].start_time = began_s
        while not done.wait(0.1):
            line.update(task, description=escape(texts[-1]))
