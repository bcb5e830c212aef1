"""All sub-commands of `calib`."""

from __future__ import annotations

from calib.cli import evaluating, files, fitting, planning, reporting, sampling, showing, surveying
from uwblink.cli.shared import new_app

app = new_app("Fit antenna delays and power curves to ultra-wideband ranges, apply them, and say how good they are.")
for room in (fitting, planning, surveying, showing, sampling, evaluating, reporting, files):
    room.add_to(app)
