"""All sub-commands of `calib`."""

from __future__ import annotations

from calib.cli import calibrating, files, judging, planning
from uwblink.cli.shared import new_app

app = new_app("Fit antenna delays and power curves to ultra-wideband ranges, apply them, and judge them.")
for room in (calibrating, planning, judging, files):
    room.add_to(app)
