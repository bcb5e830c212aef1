"""The `uwblink` command, and what all three commands share.

Nothing heavy is imported here, so that Ctrl-C works while the rest is loaded, which takes some tenths of a second.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any, Final, NoReturn

INTERRUPTED: Final = 130
"""Exit status of an interrupted command, by the convention of shells."""


def main() -> NoReturn:
    """Run the command; a user's mistake is one line on standard error and exit status 2, Ctrl-C one and 130."""
    start(_run)


def _run() -> NoReturn:
    # Here, so that the other two commands do not load what only this one needs, and Ctrl-C is answered meanwhile.
    from uwblink.cli import shared
    from uwblink.cli.commands import app

    shared.run(app)


def start(command: Callable[[], NoReturn]) -> NoReturn:
    """Import and run a command; Ctrl-C before it handles signals itself prints one line and exits with status 130."""
    signal.signal(signal.SIGINT, _leave)
    # Matrices are small here, and idle threads of the linear algebra use processor time.
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):  # read when NumPy is imported
        os.environ.setdefault(name, "1")
    try:
        command()
    finally:
        # The command is done. Its status stays true if Ctrl-C comes while the interpreter ends.
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _leave(_number: int, _frame: Any) -> NoReturn:
    """End the process at once; an exception could be caught by the module that is being imported."""
    os.write(2, b"interrupted\n")
    os._exit(INTERRUPTED)
