"""What the three commands have in common: options, version, errors as one line, and how they end."""

from __future__ import annotations

import json
import platform
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Annotated, Any, Final, NoReturn

import typer

from uwblink import __version__
from uwblink.cli.options import AsJson as AsJson
from uwblink.cli.options import Force as Force
from uwblink.cli.options import Group
from uwblink.cli.starting import INTERRUPTED as INTERRUPTED
from uwblink.errors import PluginWarning, UwblinkError

FLAGS: Final = {"map_file": "--map", "tags_from": "--tags", "duration_s": "--duration"}
"""Parameters of uwblink whose flag is called otherwise; all others are spelt alike, with dashes."""

Flags = Mapping[str, str]
"""What stands for a parameter on a command line, by its name, where it is spelt otherwise."""


def new_app(text: str) -> typer.Typer:
    """Return a command without sub-commands yet, whose help begins with `text`, and which knows `--version`."""
    app = typer.Typer(cls=Group, help=text, no_args_is_help=True, pretty_exceptions_enable=False)

    @app.callback(invoke_without_command=True)
    def top(
        ctx: typer.Context,
        version: Annotated[
            bool, typer.Option("--version", help="Print the versions of this and of what it uses.")
        ] = False,
    ) -> None:
        if version:
            typer.echo("\n".join(_versions(ctx.info_name or "uwbcal")))
            raise typer.Exit

    return app


def _versions(command: str) -> Iterator[str]:
    """Yield the version of a command, and on a line of its own those of what its results depend on."""
    from importlib.metadata import PackageNotFoundError, version

    yield f"{command.split()[-1]} {__version__}"
    found = [f"Python {platform.python_version()}"]
    # Results, files and figures depend on their versions.
    for name in ("numpy", "scipy", "duckdb", "pydantic", "simpy", "matplotlib"):
        with suppress(PackageNotFoundError):
            found.append(f"{name} {version(name)}")
    yield ", ".join(found)


def run(
    app: typer.Typer,
    *errors: type[Exception],
    statuses: Mapping[type[Exception], int] | None = None,
    arguments: Sequence[str] | None = None,
    flags: Flags = FLAGS,
) -> NoReturn:
    """Run a command and end the process: an error of `errors`, or of uwblink, is one line and status 2, Ctrl-C 130.

    `statuses` gives kinds of errors another status; `arguments` replaces those of the process; `flags` are
    those of parameters that are spelt otherwise, as `with_flags` takes them.
    """
    mistakes: tuple[type[Exception], ...] = (UwblinkError, *errors)
    status = 0
    with interrupts(at_once=True) as interrupted, _plain_warnings():
        try:
            app(args=list(sys.argv[1:] if arguments is None else arguments))
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            if not interrupted():
                text = _said(error, mistakes)
                if text is None:
                    raise
                typer.echo(f"error: {one_line(with_flags(text, FLAGS | dict(flags)))}", err=True)
                found = (number for kind, number in (statuses or {}).items() if isinstance(error, kind))
                status = next(found, 2)
    if interrupted():
        # Whatever a library made of it: an error of its own, or nothing at all.
        typer.echo("interrupted", err=True)
        status = INTERRUPTED
    sys.exit(status)


def _said(error: BaseException, mistakes: tuple[type[Exception], ...]) -> str | None:
    """Return what to say of an error that comes of what the command was given; None for one of the program."""
    if isinstance(error, mistakes):
        return str(error)
    if isinstance(error, RuntimeWarning):
        return f"numbers beyond what can be computed with ({error}); nothing was written"
    if isinstance(error, OSError):
        # Of the machine, wherever it met it: a name too long, a folder gone, a disk full.
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if isinstance(error, MemoryError):
        return "not enough memory for that; nothing was written"
    return None


def one_line(text: str) -> str:
    """Return a text with what is no printable character as an escape; names and cells of files may hold anything."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def with_flags(text: str, flags: Flags = FLAGS) -> str:
    """Return a text with flags in place of the parameters in backticks: `force` becomes --force."""
    return re.sub(r"`([a-z_]+)`", lambda found: flags.get(found[1], f"--{found[1].replace('_', '-')}"), text)


def print_json(document: Any) -> None:
    """Print a document as JSON."""
    typer.echo(json.dumps(document, indent=1))


@contextmanager
def interrupts(*, at_once: bool = False) -> Iterator[Callable[[], bool]]:
    """Turn Ctrl-C and a polite kill into a question to ask; a second one interrupts.

    With `at_once` the first one interrupts, too, and the question is whether one did. The second one then is not taken:
    it would interrupt the tidying up. A third one ends what hangs.
    """
    asked: list[int] = []

    def note(number: int, _frame: Any) -> None:
        asked.append(number)
        if len(asked) != (2 if at_once else 1):
            raise KeyboardInterrupt

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print what is wrong with plug-ins as one line, as errors are; take overflows and the like for errors."""
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, PluginWarning):
            typer.echo(f"warning: {message}", err=True)
        else:
            shown(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of NumPy: what comes after them is nonsense
        warnings.showwarning = show
        yield
