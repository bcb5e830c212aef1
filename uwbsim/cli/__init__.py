"""The `uwbsim` command."""

from __future__ import annotations

import sys
from typing import Any, NoReturn

import typer

from uwblink.cli import shared
from uwbsim.cli import flights, workbench
from uwbsim.errors import UwbsimError

app = shared.new_app("Simulate tags that range with ultra-wideband radios.")
for room in (flights, workbench):
    room.add_to(app)


def main() -> NoReturn:
    """Run the command; a user's mistake is one line on standard error and exit status 2."""
    shared.run(app, UwbsimError, wording=_with_option)


def _with_option(text: str) -> str:
    """Return a message that begins with a parameter with what that is called on the command line: `-n/--ranges`."""
    parameter, colon, rest = text.partition(": ")
    group: Any = typer.main.get_command(app)
    commands = [group.commands[word] for word in sys.argv[1:] if word in group.commands]
    options = [p for command in commands[:1] for p in command.params if p.name == parameter]
    return "/".join(options[0].opts) + colon + rest if options else text
