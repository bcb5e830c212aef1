"""The `uwblink` command, and what all three commands share."""

from __future__ import annotations

from typing import NoReturn

from uwblink.cli.starting import start


def main() -> NoReturn:
    """Run the command; a user's mistake is one line on standard error and exit status 2, Ctrl-C one and 130."""
    start(_run)


def _run() -> NoReturn:
    # Here, so that the other two commands do not load what only this one needs, and Ctrl-C is answered meanwhile.
    from uwblink.cli import shared
    from uwblink.cli.commands import app

    shared.run(app)
