"""Start of the three commands, before their modules are imported.

Nothing heavy is imported here, so that Ctrl-C works while the rest is loaded, which takes some tenths of a second.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from typing import Any, Final, NoReturn

INTERRUPTED: Final = 130
"""Exit status of an interrupted command, by the convention of shells."""


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
