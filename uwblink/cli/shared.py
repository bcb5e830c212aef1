"""What the three commands share: version, errors as one line, interrupts, JSON, and the line that shows progress."""

from __future__ import annotations

import json
import platform
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from threading import Timer
from types import FrameType
from typing import Annotated, Any, Final, NoReturn

import typer

from uwblink import __version__
from uwblink.cli import INTERRUPTED as INTERRUPTED
from uwblink.cli.guide import AsJson as AsJson
from uwblink.cli.guide import Force as Force
from uwblink.cli.guide import Group
from uwblink.errors import PluginWarning, UwblinkError

FLAGS: Final = {"map_file": "--map", "tags_from": "--tags", "duration_s": "--duration"}
"""Flags of parameters of uwblink that differ from the parameter's name with dashes."""

IMPORT_POLL_S: Final = 0.02
"""Time between looks whether an import has ended that delays an interrupt; shorter than a person notices."""

Flags = Mapping[str, str]
"""Flags by parameter, where they differ from the parameter's name with dashes."""


def new_app(text: str) -> typer.Typer:
    """Return a command with `--version` and without sub-commands; `text` begins its help."""
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
    """Yield the version of a command, and those of the libraries on which its results depend."""
    from importlib.metadata import PackageNotFoundError, version

    yield f"{command.split()[-1]} {__version__}"
    found = [f"Python {platform.python_version()}"]
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
    """Run a command and end the process. Errors of `errors` and of uwblink print one line; the status is 2, 130 after
    Ctrl-C.

    `statuses` gives kinds of errors another status; `arguments` replaces those of the process; for `flags` see
    `with_flags`.
    """
    mistakes: tuple[type[Exception], ...] = (UwblinkError, *errors)
    status = 0
    with interrupts(at_once=True) as interrupted, _plain_warnings():
        try:
            app(args=list(sys.argv[1:] if arguments is None else arguments))
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            if not interrupted():
                text = _message(error, mistakes)
                if text is None:
                    raise
                typer.echo(f"error: {one_line(with_flags(text, FLAGS | dict(flags)))}", err=True)
                found = (number for kind, number in (statuses or {}).items() if isinstance(error, kind))
                status = next(found, 2)
    if interrupted():
        # A library may have turned the interrupt into an error of its own, or swallowed it.
        typer.echo("interrupted", err=True)
        status = INTERRUPTED
    sys.exit(status)


def _message(error: BaseException, mistakes: tuple[type[Exception], ...]) -> str | None:
    """Return the message for an error caused by input or by the machine; None for an error of the program."""
    if isinstance(error, mistakes):
        return str(error)
    if isinstance(error, RuntimeWarning):
        return f"numbers beyond what can be computed with ({error}); nothing was written"
    if isinstance(error, OSError):
        # For example a name that is too long, a folder that was removed, or a full disk.
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if isinstance(error, MemoryError):
        return "not enough memory for that; nothing was written"
    return None


def one_line(text: str) -> str:
    """Return a text with escapes for characters that are not printable, which names and cells of files may have."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def with_flags(text: str, flags: Flags = FLAGS) -> str:
    """Return a text with flags in place of the parameters in backticks: `force` becomes --force."""
    return re.sub(r"`([a-z_]+)`", lambda found: flags.get(found[1], f"--{found[1].replace('_', '-')}"), text)


def print_json(document: Any) -> None:
    """Print a document as JSON."""
    typer.echo(json.dumps(document, indent=1))


def print_result(document: Any, text: str, *, as_json: bool) -> None:
    """Print a result as JSON or as text."""
    typer.echo(json.dumps(document, indent=1) if as_json else text)


@contextmanager
def interrupts(*, at_once: bool = False) -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGINT or SIGTERM came; a second signal raises `KeyboardInterrupt`.

    With `at_once` the first signal raises it, too, and the second one is ignored, because it would interrupt the
    cleaning up. A third one ends the process without cleaning up, also where a library waits for ever. While a module
    is being imported it is raised after the import: Python drops exceptions in the callbacks of its import system, and
    the command would go on.
    """
    asked: list[int] = []

    def note(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        if len(asked) == 2:
            for each in before:
                signal.signal(each, signal.SIG_DFL)
        if len(asked) == (1 if at_once else 2):
            leave(number, frame)

    def leave(_number: int, frame: FrameType | None) -> None:
        if hasattr(signal, "setitimer") and _is_importing(frame):
            signal.signal(signal.SIGALRM, leave)
            signal.setitimer(signal.ITIMER_REAL, IMPORT_POLL_S)
        else:
            raise KeyboardInterrupt

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether a frame was called by Python's import system."""
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            return True
        frame = frame.f_back
    return False


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print warnings about plug-ins as one line, and raise overflows and the like as errors."""
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, PluginWarning):
            typer.echo(f"warning: {message}", err=True)
        else:
            shown(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of NumPy: results after an overflow are meaningless
        warnings.showwarning = show
        yield


@contextmanager
def waiting(what: str, *, after_s: float = 1.0) -> Iterator[Callable[[str], object]]:
    """Show on a terminal what the block does, as in "fitting", if it takes longer than `after_s` seconds.

    Nothing is shown elsewhere, and the line is gone after the block, which must not print. Yields a function that
    replaces the text.
    """
    if not sys.stderr.isatty():
        yield lambda _what: None
        return
    from rich.console import Console
    from rich.markup import escape
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn("line"), TextColumn("{task.description}"), TimeElapsedColumn())
    line = Progress(*columns, console=Console(stderr=True), transient=True)
    task = line.add_task(escape(what), total=None)
    begin = Timer(after_s, line.start)
    begin.daemon = True
    begin.start()
    try:
        yield lambda text: line.update(task, description=escape(text))
    finally:
        begin.cancel()
        begin.join()
        if line.live.is_started:
            line.stop()
