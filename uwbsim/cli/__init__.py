"""The `uwbsim` command."""

from __future__ import annotations

from typing import NoReturn

from uwblink.cli.starting import start


def main() -> NoReturn:
    """Run the command; a user's mistake is one line on standard error and exit status 2, Ctrl-C one and 130."""
    start(_run)


def _run() -> NoReturn:
    # Here, so that Ctrl-C is answered while these are loaded.
    from uwblink.cli import shared
    from uwbsim.cli.commands import FLAGS, app
    from uwbsim.errors import UwbsimError

    shared.run(app, UwbsimError, flags=FLAGS)
