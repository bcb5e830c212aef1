"""Arguments that several commands share, and the bar that shows how far long work has come."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from uwblink.cli import shared
from uwblink.cli.guide import starting


def shipped(incomplete: str) -> list[str]:
    """Return the scenarios that come along, for a shell; it completes files itself where nothing was typed yet."""
    from uwbsim import shipped_scenarios

    return starting(incomplete, shipped_scenarios()) if incomplete else []


ScenarioFile = Annotated[
    Path, typer.Argument(help="Scenario file (.toml), or the name of one that comes along.", autocompletion=shipped)
]
Overrides = Annotated[list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one value.")]
AllowFiles = Annotated[
    list[Path] | None,
    typer.Option(metavar="DIR", help="Folder of files that a scenario may name, beside its own; as often as needed."),
]
AsJson = shared.AsJson
Force = shared.Force


@contextmanager
def progress(name: str, *, eta: bool = False) -> Iterator[Callable[[float], None] | None]:
    """Show a bar on a terminal, and nothing elsewhere."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=not eta) as bar:
        task = bar.add_task(escape(name), total=1.0)
        yield lambda fraction: bar.update(task, completed=fraction)
