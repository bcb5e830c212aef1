"""Start of the three commands, before their modules are imported.

Nothing heavy is imported here: Ctrl-C is answered while the rest is loaded, which takes some tenths of a second.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
from collections.abc import Callable
from typing import Any, Final, NoReturn

INTERRUPTED: Final = 130
"""Exit status of a command that Ctrl-C ended before it was done, as shells have it."""


def start(command: Callable[[], NoReturn]) -> NoReturn:
    """Import and run a command; until it answers Ctrl-C itself, that is one line and status 130."""
    before = signal.signal(signal.SIGINT, _leave)
    # Importing and drawing make many objects that stay: searched for cycles every 700, they cost a tenth of the time.
    gc.set_threshold(50_000)
    # Matrices are small here, and threads that wait for large ones do so by counting: a tenth of a command's time.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # read when NumPy is imported
        os.environ.setdefault(name, "1")
    try:
        command()
    finally:
        signal.signal(signal.SIGINT, before)


def keep_imported() -> None:
    """Exclude all objects so far from garbage collection.

    For commands that draw: Matplotlib is a hundred thousand objects, and searching them a tenth of a page's time. Not
    where DuckDB is loaded, which looks at the end for what is left of it, and would print what no search found.
    """
    if "duckdb" not in sys.modules:
        gc.freeze()


def _leave(_number: int, _frame: Any) -> NoReturn:
    """End the process at once: an exception could be taken by the module that is being imported, and reported."""
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
