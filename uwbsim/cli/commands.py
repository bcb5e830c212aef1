"""All sub-commands of `uwbsim`."""

from __future__ import annotations

from typing import Final

from uwblink.cli.shared import new_app
from uwbsim.cli import flights, workbench

app = new_app("Simulate tags that range with ultra-wideband radios.")
for room in (flights, workbench):
    room.add_to(app)

FLAGS: Final = {"count": "-n/--ranges", "overhead_s": "--overhead-us", "overrides": "--set", "evaluate": "evaluate"}
"""Of parameters that are spelt otherwise; what evaluates a sweep is a plug-in, which no flag names."""
