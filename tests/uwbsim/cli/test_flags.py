"""Errors of uwbsim name parameters, and its command line the flags that stand for them."""

import re
from pathlib import Path
from typing import Any

import typer

import uwbsim
from uwblink.cli.shared import with_flags
from uwbsim.cli.commands import UWBSIM_FLAGS, app

ROOT = Path(__file__).parents[3]
COMMANDS: Any = typer.main.get_command(app)
OPTIONS = {"/".join(p.opts) for command in COMMANDS.commands.values() for p in command.params}
# Of functions that no command calls with what a user typed.
ONLY_FROM_PYTHON = {"effect", "source", "name", "evaluate", "lost_share"}


def test_every_parameter_that_an_error_names_has_its_flag():
    named = set()
    for path in (ROOT / "uwbsim").rglob("*.py"):
        named |= set(re.findall(r'parameter="([a-z_0-9]+)"', path.read_text()))
    assert {"count", "overrides", "overhead_s", "workers"} <= named
    assert {with_flags(f"`{name}`", UWBSIM_FLAGS) for name in named - ONLY_FROM_PYTHON} <= OPTIONS


def test_every_number_of_a_state_has_its_flag():
    assert {with_flags(f"`{name}`", UWBSIM_FLAGS) for name in uwbsim.State.__dataclass_fields__} <= OPTIONS
