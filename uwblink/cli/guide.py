"""What guides whoever types a command: examples in its help, panels, and names that a shell completes."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import wraps
from pathlib import Path
from typing import Any, Final

import typer

COMMA: Final = ","
"""What separates names in one word."""

WRITTEN: Final = ("output", "pdf", "figures", "report", "tum", "plot", "anchors")
"""Parameters of commands that name what is written; all other paths are read."""

WIDEST: Final = 20
"""Letters that names may take in the column of an option's values, in a terminal of 80 columns."""


def add(
    app: typer.Typer, command: Callable[..., None], *examples: str, panel: str | None = None, name: str | None = None
) -> None:
    """Register a command in a panel of the list of commands, with examples below its own help."""
    app.command(name, rich_help_panel=panel, epilog=epilog(*examples))(apart(command))


def apart(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that refuses, before it does anything, to write over its own outputs and inputs."""

    @wraps(command)
    def run(**given: Any) -> None:
        from uwblink.output import check_apart

        outputs = {name: given[name] for name in WRITTEN if isinstance(given.get(name), Path)}
        others = (value for name, value in given.items() if name not in outputs)
        check_apart(outputs, [path for value in others for path in _paths(value)])
        command(**given)

    return run


def _paths(value: Any) -> list[Path]:
    several = value if isinstance(value, list | tuple) else [value]
    return [one for one in several if isinstance(one, Path)]


def epilog(*examples: str) -> str | None:
    """Return examples as an epilog, a line each; None without any."""
    heads = ["Example:" if len(examples) == 1 else "Examples:"]
    return "\n".join([*heads, *(f"  {plain(one)}" for one in examples)]) if examples else None


def plain(text: str) -> str:
    """Return a text in which nothing is markup: rich escapes it, and is loaded only where there is a bracket."""
    if "[" not in text:
        return text
    from rich.markup import escape

    return escape(text)


def choice(*names: str, more: Callable[[], Iterable[str]] | None = None) -> dict[str, Any]:
    """Return what `typer.Option` and `typer.Argument` take for one of `names`: shown in the help, and completed.

    `more` returns the names where plug-ins may add some. The package that is called says what it does not know, so
    that the command and Python say the same.
    """

    def complete(incomplete: str) -> list[str]:
        return starting(incomplete, names if more is None else more())

    together = "|".join(names)
    # Where they do not fit in their column, they are broken between names.
    return {"metavar": together if len(together) <= WIDEST else " | ".join(names), "autocompletion": complete}


def several(names: Callable[[], Iterable[str]]) -> dict[str, Any]:
    """Return what `typer.Option` takes for names with commas between, whose last one is completed."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(COMMA)
        taken = set(before.split(COMMA))
        return [f"{before}{comma}{name}" for name in starting(last, names()) if name not in taken]

    return {"metavar": "NAME,...", "autocompletion": complete}


def starting(incomplete: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with what was typed."""
    return [name for name in names if name.startswith(incomplete)]


def tags_of(form: str = "{}") -> Callable[[typer.Context, str], list[str]]:
    """Return a completion with the tags of the recordings that stand on the command line before the option.

    Those are what is left over of the line: it ends where the option wants a value, so it has not been parsed.
    """

    def complete(ctx: typer.Context, incomplete: str) -> list[str]:
        return starting(incomplete, (form.format(tag) for tag in _tags(map(Path, ctx.args))))

    return complete


def _tags(paths: Iterable[Path]) -> list[int]:
    from uwblink import Recording, UwblinkError

    found: set[int] = set()
    for path in paths:
        try:
            with Recording.open(path) as recording:
                found |= {tag.tag for tag in recording.tags()}
        except UwblinkError:  # a shell that completes has nobody to tell
            continue
    return sorted(found)
