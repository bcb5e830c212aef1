"""The `calib` command."""

from __future__ import annotations

import sys
from typing import NoReturn

from calib.cli import evaluating, files, fitting, reporting, showing
from calib.cli.flags import FLAGS
from calib.errors import CalibError, UnanswerableError
from uwblink.cli import shared

app = shared.new_app(
    "Fit antenna delays and power curves to ultra-wideband ranges, apply them, and say how good they are."
)
for room in (fitting, showing, evaluating, reporting, files):
    room.add_to(app)


def main() -> NoReturn:
    """Run the command; a mistake is one line on standard error, status 2, or 1 (see docs)."""
    words = reporting.spread(sys.argv[1:])
    shared.run(app, CalibError, statuses={UnanswerableError: 1}, arguments=words, flags=FLAGS)
