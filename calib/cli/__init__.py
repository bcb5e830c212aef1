"""The `calib` command."""

from __future__ import annotations

from typing import NoReturn

from uwblink.cli import start


def main() -> NoReturn:
    """Run the command and exit.

    An error is one line on standard error. Exit status: 0 done, 1 the data cannot answer, 2 bad input, 130 Ctrl-C.
    """
    start(_run)


def _run() -> NoReturn:
    # Imported here, so that Ctrl-C is handled during the imports.
    import sys

    from calib.cli.commands import app
    from calib.cli.judging import spread_tests
    from calib.cli.shared import CALIB_FLAGS
    from calib.errors import CalibError, UnanswerableError
    from uwblink.cli import shared

    words = spread_tests(sys.argv[1:])
    shared.run(app, CalibError, statuses={UnanswerableError: 1}, arguments=words, flags=CALIB_FLAGS)
