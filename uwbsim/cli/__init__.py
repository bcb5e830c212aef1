"""The `uwbsim` command."""

from __future__ import annotations

from typing import NoReturn

from uwblink.cli import start


def main() -> NoReturn:
    """Run the command; a mistake is one line and exit status 2, data that cannot answer 1, Ctrl-C 130."""
    start(_run)


def _run() -> NoReturn:
    # Here, so that Ctrl-C is answered while these are loaded.
    from uwblink.cli import shared
    from uwbsim.cli.commands import UWBSIM_FLAGS, app
    from uwbsim.errors import TooFewDataError, UwbsimError

    shared.run(app, UwbsimError, statuses={TooFewDataError: 1}, flags=UWBSIM_FLAGS)
