"""Arguments of several commands, and their progress bar."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

import uwbsim
from uwblink.cli.guide import starting


def shipped(incomplete: str) -> list[str]:
    """Complete the name of a shipped scenario; where nothing was typed yet, the shell completes files."""
    return starting(incomplete, uwbsim.shipped_scenarios()) if incomplete else []


ScenarioFile = Annotated[
    Path, typer.Argument(help="Scenario file (.toml), or the name of a shipped one.", autocompletion=shipped)
]
Overrides = Annotated[
    list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one value; repeatable.")
]
AllowFiles = Annotated[
    list[Path] | None,
    typer.Option(metavar="DIR", help="Further folder in which files that the scenario names may lie; repeatable."),
]


@contextmanager
def progress(name: str, *, eta: bool = False) -> Iterator[Callable[[float], None]]:
    """Show on a terminal how far work has come, and nothing elsewhere; yields a function of the done fraction."""
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=not eta, disable=not sys.stderr.isatty()) as bar:
        task = bar.add_task(escape(name), total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)
