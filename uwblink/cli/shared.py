"""Functions and options that the three commands share.

Options, old names of options, examples, panels, completion, and options made of settings; version, errors as one line,
interrupts, JSON, and the line that shows progress.
"""

from __future__ import annotations

import json
import platform
import re
import signal
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import Field, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from traceback import walk_stack
from types import FrameType
from typing import Annotated, Any, Final, NoReturn, get_type_hints

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import (
    Progress,
    SpinnerColumn,
    TaskProgressColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from typer.core import TyperCommand, TyperGroup

from uwblink import __version__
from uwblink.cli import INTERRUPTED as INTERRUPTED
from uwblink.errors import ArgumentError, OfParameter, PlainWarning, UwblinkError
from uwblink.output import check_apart
from uwblink.settings import flags_of

FLAGS: Final = {"source": "--from", "map_file": "--map", "tags_from": "--tags", "duration_s": "--duration"}
"""Flags of parameters of uwblink that differ from the parameter's name with dashes."""

USAGE_ERROR: Any = typer.BadParameter.__base__
"""What Typer raises for wrong words of a command line; it has no public name."""

Flags = Mapping[str, str]
"""Flags by parameter, where they differ from the parameter's name with dashes."""


Force = Annotated[bool, typer.Option("--force", help="Replace existing output.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON (SI units; delays in ns).")]
CalibrationFile = Annotated[Path, typer.Option("-c", "--calibration", help="Calibration file (.json).")]
OptionalCalibration = Annotated[Path | None, typer.Option("-c", "--calibration", help="Calibration file (.json).")]
AntennaDelays = Annotated[
    Path | None,
    typer.Option(help="Antenna delays programmed into the boards (.toml, as calib export writes them)."),
]
Duration = Annotated[float | None, typer.Option(min=0.001, help="Duration in seconds.")]
Rate = Annotated[float | None, typer.Option(min=0.001, help="Exchanges per second, all pairs together (Hz).")]
DialectName = Annotated[
    str | None,
    typer.Option(
        "--dialect",
        metavar="NAME|MAP",
        help="Text format of boards with other firmware: dwm1001-lec, dwm1001-les, at-range, arduino, ..., "
        "or a column map with a line template (.toml).",
    ),
]
BoardIds = Annotated[
    str,
    typer.Option(
        "--ids", metavar="ID,ID...", help="Ids of the boards, in the order of the ports, if their lines have no ids."
    ),
]
PlanFile = Annotated[Path | None, typer.Option("--plan", help="Ranging plan: which pairs range, and how (.toml).")]
PlaybackSpeed = Annotated[
    float, typer.Option("--speed", min=0.001, help="Playback speed as a factor; inf: as fast as possible.")
]
LinkDir = Annotated[Path | None, typer.Option(help="Folder for links with stable names to the pseudo-terminals.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of the random numbers.")]
Seeds = Annotated[int | None, typer.Option(min=1, help="Number of simulated runs, each with another seed.")]
Figures = Annotated[
    Path | None, typer.Option("--figures", help="Folder for the figures (.pdf and .svg, one and two columns wide).")
]
ReportFile = Annotated[Path | None, typer.Option("--report", help="Report to write (.html or .pdf).")]
Plot = Annotated[Path | None, typer.Option("--plot", help="Picture to write (.png, .svg or .pdf).")]


def output(sentence: str) -> Any:
    """Return the option for an output, as in `Annotated[Path, output("Recording to write (.uwb).")]`."""
    return typer.Option("-o", "--output", help=sentence)


def count(sentence: str, *, min: int = 1, max: int | None = None) -> Any:  # noqa: A002 - as in typer
    """Return the option for a number of things, as in `Annotated[int, count("Number of exchanges.")]`."""
    return typer.Option("-n", "--count", help=sentence, min=min, max=max)


class _PlainFlags:
    def get_params(self, ctx: Any) -> Any:
        """Return the parameters; flags are shown without a value."""
        parameters = super().get_params(ctx)  # type: ignore[misc]  # that of the class beside it
        for one in parameters:
            if getattr(one, "is_flag", False):
                one.metavar = ""
        return parameters


class TerseCommand(_PlainFlags, TyperCommand):
    """A command that shows no type for flags, and rejects old names of its options with the new ones."""

    renamed: Mapping[str, str] = {}

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; raises `ArgumentError` for an old name."""
        for word in () if ctx.resilient_parsing else args:
            old = word.partition("=")[0]
            if old in self.renamed:
                raise ArgumentError(f"{old} is now {self.renamed[old]}")
        return super().parse_args(ctx, args)


class Group(_PlainFlags, TyperGroup):
    """A group of commands that shows no type for flags; `moved` is the error for an unknown command."""

    moved = ""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the command line; raises `ArgumentError` if the group is called as the command that it was before."""
        if self.moved and not ctx.resilient_parsing and args and args[0] not in (*self.list_commands(ctx), "--help"):
            raise ArgumentError(self.moved)
        return super().parse_args(ctx, args)


WRITTEN: Final = ("output", "pdf", "figures", "report", "tum", "plot")
"""Parameters of commands that are outputs; all other paths are inputs."""


def add(
    app: typer.Typer,
    command: Callable[..., None],
    *examples: str,
    panel: str | None = None,
    name: str | None = None,
    renamed: Mapping[str, str] | None = None,
) -> None:
    """Register a command in a panel of the list of commands, with examples below its own help.

    A parameter that is a dataclass of settings (`uwblink.settings`) becomes one option for each field, and errors name
    its fields by their options. `renamed` maps old names of options to the new ones for the error "--old is now --new".
    """
    kind = type("RenamedCommand", (TerseCommand,), {"renamed": renamed}) if renamed else TerseCommand
    app.command(name, cls=kind, rich_help_panel=panel, epilog=epilog(*examples))(apart(with_settings(command)))


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the fields of its dataclasses of settings as parameters of their own."""
    hints = get_type_hints(command, include_extras=True)
    settings = {name: hints[name] for name in signature(command).parameters if is_dataclass(hints[name])}
    if not settings:
        return command
    parameters = []
    for name, one in signature(command).parameters.items():
        if name in settings:
            types = get_type_hints(settings[name])
            parameters += [_parameter(field, types[field.name]) for field in fields(settings[name]) if field.metadata]
        else:
            parameters.append(one.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[name]))

    flags = {name: flag for kind in settings.values() for name, flag in flags_of(kind).items()}

    @wraps(command)
    def run(**given: Any) -> None:
        try:
            for name, kind in settings.items():
                values = [(field, given.pop(field.name)) for field in fields(kind) if field.metadata]
                given[name] = kind(**{f.name: _parsed(f, value) for f, value in values if value not in (None, [], ())})
            command(**given)
        except OfParameter as error:
            # Other names in backticks are replaced by the caller, which knows their options.
            error.args = (re.sub(r"`([a-z_]+)`", lambda found: flags.get(found[1], found[0]), str(error)),)
            raise

    run.__signature__ = Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    return run


def _parameter(field: Field[Any], kind: Any) -> Parameter:
    """Return the option of a field of settings as a parameter of a command."""
    how = dict(field.metadata)
    shown = dict(how["shown"])
    if how["names"]:
        shown |= choice(*how["names"], more=how["more"])
    if how["tags"]:
        shown["autocompletion"] = tags_of(how["tags"])
    flag = how["flag"] or f"--{field.name.replace('_', '-')}"
    default = None if how["parse"] else field.default
    option = typer.Option(flag, help=how["help"], **shown)
    typed: Any = how["kind"] or kind
    return Parameter(field.name, Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[typed, option])


def _parsed(field: Field[Any], value: Any) -> Any:
    """Return the value of a field from the command line; an error of parsing names the field."""
    parse = field.metadata["parse"]
    try:
        return parse(value) if parse else value
    except OfParameter as error:
        if error.parameter is None:
            error.args = (f"`{field.name}`: {error}",)
        raise


def apart(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that first checks that its outputs differ from each other and from its inputs."""

    @wraps(command)
    def run(**given: Any) -> None:
        outputs = {name: given[name] for name in WRITTEN if isinstance(given.get(name), Path)}
        others = (
            value if isinstance(value, list | tuple) else [value] for n, value in given.items() if n not in outputs
        )
        check_apart(outputs, [one for values in others for one in values if isinstance(one, Path)])
        command(**given)

    return run


def epilog(*examples: str) -> str | None:
    """Return examples as an epilog, a line each; None without any."""
    head = "Example:" if len(examples) == 1 else "Examples:"
    return "\n".join([head, *(f"  {escape(one)}" for one in examples)]) if examples else None


def choice(*names: str, more: Callable[[], Iterable[str]] | None = None) -> dict[str, Any]:
    """Return arguments of `typer.Option` and `typer.Argument` for one of `names`: shown in the help, and completed.

    `more` returns all names if plug-ins can add some. Unknown names are rejected by the package that is called, so that
    the command and Python have the same errors.
    """

    def complete(incomplete: str) -> list[str]:
        return starting(incomplete, names if more is None else more())

    together = "|".join(names)
    # Names that do not fit in their column of 20 letters are broken into lines.
    return {"metavar": together if len(together) <= 20 else " | ".join(names), "autocompletion": complete}


def several(names: Callable[[], Iterable[str]]) -> dict[str, Any]:
    """Return arguments of `typer.Option` for names separated by commas; the last one is completed."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        taken = set(before.split(","))
        return [f"{before}{comma}{name}" for name in starting(last, names()) if name not in taken]

    return {"metavar": "NAME,...", "autocompletion": complete}


def starting(incomplete: str, names: Iterable[str]) -> list[str]:
    """Return the names that begin with a text."""
    return [name for name in names if name.startswith(incomplete)]


def tags_of(form: str = "{}") -> Callable[[typer.Context, str], list[str]]:
    """Return a completion with the tags of the recordings on the command line before the option.

    These are the remaining arguments: the line ends at an option without its value, so it was not parsed.
    """

    def complete(ctx: typer.Context, incomplete: str) -> list[str]:
        from uwblink import Recording

        found: set[int] = set()
        for path in ctx.args:
            # Completion does not report errors.
            with suppress(UwblinkError), Recording.open(path) as recording:
                found |= {tag.tag for tag in recording.tags()}
        return starting(incomplete, map(form.format, sorted(found)))

    return complete


def new_app(text: str) -> typer.Typer:
    """Return a command with `--version` and without sub-commands; `text` begins its help."""
    app = typer.Typer(cls=Group, help=text, no_args_is_help=True, pretty_exceptions_enable=False)

    @app.callback(invoke_without_command=True)
    def top(
        ctx: typer.Context,
        version: Annotated[
            bool, typer.Option("--version", help="Print the versions of this program and of its libraries.")
        ] = False,
    ) -> None:
        if version:
            typer.echo(_versions(ctx.info_name or "uwbcal"))
            raise typer.Exit

    return app


def _versions(command: str) -> str:
    """Return the version of a command, and those of the libraries on which its results depend."""
    from importlib.metadata import version

    names = ("numpy", "scipy", "duckdb", "pydantic", "simpy", "matplotlib")
    libraries = ", ".join(f"{name} {version(name)}" for name in names)
    return f"{command.split()[-1]} {__version__}\nPython {platform.python_version()}, {libraries}"


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
            status = app(args=list(sys.argv[1:] if arguments is None else arguments), standalone_mode=False) or 0
        except (Exception, KeyboardInterrupt, SystemExit) as error:
            if not interrupted():
                text = _message(error, mistakes)
                if text is None:
                    raise
                if text:
                    typer.echo(f"error: {one_line(with_flags(text, FLAGS | dict(flags)))}", err=True)
                status = next((number for kind, number in (statuses or {}).items() if isinstance(error, kind)), 2)
    if interrupted():
        # A library may have turned the interrupt into an error of its own, or swallowed it.
        typer.echo("interrupted", err=True)
        status = INTERRUPTED
    sys.exit(status)


def _message(error: BaseException, mistakes: tuple[type[Exception], ...]) -> str | None:
    """Return the message for an error caused by input or by the machine; None for an error of the program.

    It is empty where a command without words has printed its help.
    """
    if isinstance(error, mistakes):
        return str(error)
    if isinstance(error, USAGE_ERROR):
        said, where = error.format_message().rstrip("."), getattr(error.ctx, "command_path", "")
        said = said[:1].lower() + said[1:]
        return f"{where}: {said}; see '{where} --help'" if said and where else said
    if isinstance(error, RuntimeWarning):
        return f"numbers are too large for the computation ({error}); nothing was written"
    if isinstance(error, OSError):
        # For example a name that is too long, a folder that was removed, or a full disk.
        return f"{error.filename}: {error.strerror}" if error.filename else str(error)
    if isinstance(error, MemoryError):
        return "not enough memory; nothing was written"
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
        importing = any(one.f_globals.get("__name__") == "importlib._bootstrap" for one, _ in walk_stack(frame))
        if not importing or not hasattr(signal, "setitimer"):
            raise KeyboardInterrupt
        signal.signal(signal.SIGALRM, leave)
        signal.setitimer(signal.ITIMER_REAL, 0.02)  # look again soon, sooner than a person notices

    before = {number: signal.signal(number, note) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: bool(asked)
    finally:
        if hasattr(signal, "setitimer"):
            signal.setitimer(signal.ITIMER_REAL, 0)
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def _plain_warnings() -> Iterator[None]:
    """Print the project's own warnings as one line each, and raise overflows and the like as errors."""
    shown = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if issubclass(category, PlainWarning):
            typer.echo(f"warning: {message}", err=True)
        else:
            shown(message, category, *where, **more)

    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)  # of NumPy: results after an overflow are meaningless
        warnings.showwarning = show
        yield


@contextmanager
def waiting(what: str) -> Iterator[Callable[[str | float], None]]:
    """Show on a terminal what the block does, as in "fitting"; the line is gone after the block, which must not print.

    Yields a function that takes another text, or the share that is done (0 to 1), from which the line states the time
    left. Nothing is shown elsewhere.
    """
    if not sys.stderr.isatty():
        yield lambda _: None
        return
    columns = (SpinnerColumn("line"), TextColumn("{task.description}"), TaskProgressColumn(), TimeElapsedColumn())
    left = (TimeRemainingColumn(), TextColumn("{task.fields[left]}"))  # nothing where a block states no share
    with Progress(*columns, *left, console=Console(stderr=True), transient=True) as line:
        task = line.add_task(escape(what), total=None, left="")

        def update(found: str | float) -> None:
            if isinstance(found, str):
                line.update(task, description=escape(found))
            else:
                line.update(task, total=1.0, completed=found, left="left")

        yield update
