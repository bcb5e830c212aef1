"""Options of the present commands: their names, and values that fit and that do not."""

from __future__ import annotations

import functools
import importlib
import random
from collections.abc import Mapping, Sequence
from typing import Any, Final

import typer

from docs.site.commands import leaves
from tests.fuzz.mutations import WORDS

PACKAGES: Final = ("uwblink", "uwbsim", "calib")
NEVER: Final = frozenset({"--help", "--scheduler", "--foxglove", "--udp", "--serve", "--speed", "--duration", "--live"})
"""Options that wait for other processes, or for a given time."""

NUMBERS: Final = ("0", "1", "3", "-1", "0.5", "1e-9", "1e300", "nan", "inf", "-inf", "9" * 30)
PLAIN: Final = (
    "1", "1,2", "1=0.5", "1-2=3", "all", "none", "auto", "a=b", "{flight.uwb}", "{calibration.json}", "{known.toml}",
)  # fmt: skip


@functools.cache
def commands() -> Mapping[str, Any]:
    """Return every command without sub-commands, by the words that call it."""
    apps = {package: importlib.import_module(f"{package}.cli.commands").app for package in PACKAGES}
    found = {name: leaves(typer.main.get_command(app), (name,)) for name, app in apps.items()}
    return {" ".join(words): command for some in found.values() for words, command in some}


def command_of(words: Sequence[str]) -> str:
    """Return the words that call the command of a line, such as `calib fit`."""
    return next(name for name in (" ".join(words[:3]), " ".join(words[:2])) if name in commands())


def another_option(words: Sequence[str], rng: random.Random) -> list[str]:
    """Return an option of a command, and a value if it takes one."""
    known = commands()[command_of(words)].params
    options = [p for p in known if p.opts[0].startswith("-") and p.opts[-1] not in NEVER]
    if not options:
        return []
    option, value = rng.choice(options), rng.choice(rng.choice((NUMBERS, PLAIN, WORDS)))
    return [option.opts[-1], *([] if getattr(option, "is_flag", False) else [value])]
