"""The `uwbsim` command."""

from __future__ import annotations

from typing import Final, NoReturn

from uwblink.cli import shared
from uwbsim.cli import flights, twins, workbench
from uwbsim.errors import UwbsimError

app = shared.new_app("Simulate tags that range with ultra-wideband radios.")
for room in (flights, workbench, twins):
    room.add_to(app)

FLAGS: Final = {"count": "-n/--ranges", "overhead_s": "--overhead-us", "overrides": "--set", "evaluate": "evaluate"}
"""Of parameters that are spelt otherwise; what evaluates a sweep is a plug-in, which no flag names."""


def main() -> NoReturn:
    """Run the command; a user's mistake is one line on standard error and exit status 2."""
    shared.run(app, UwbsimError, flags=FLAGS)
