"""Options that the commands share, old names of options, examples, panels, completion, and options made of settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Final, get_type_hints

import typer
from typer.core import TyperCommand, TyperGroup

from uwblink.errors import ArgumentError, OfParameter
from uwblink.settings import flags_of

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


class Command(_PlainFlags, TyperCommand):
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
    kind = type("RenamedCommand", (Command,), {"renamed": renamed}) if renamed else Command
    app.command(name, cls=kind, rich_help_panel=panel, epilog=epilog(*examples))(apart(with_settings(command)))


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Return a command that takes the fields of its dataclasses of settings as parameters of their own."""
    hints = get_type_hints(command, include_extras=True)
    settings = {name: hints[name] for name in signature(command).parameters if is_dataclass(hints[name])}
    if not settings:
        return command
    parameters = []
    for name, one in signature(command).parameters.items():
        if name not in settings:
            parameters.append(one.replace(kind=Parameter.KEYWORD_ONLY, annotation=hints[name]))
            continue
        types = get_type_hints(settings[name])
        for field in fields(settings[name]):
            if field.metadata:
                parameters.append(_parameter(field, types[field.name]))

    flags = {name: flag for kind in settings.values() for name, flag in flags_of(kind).items()}

    @wraps(command)
    def run(**given: Any) -> None:
        try:
            for name, kind in settings.items():
                values = {}
                for field in fields(kind):
                    value = given.pop(field.name) if field.metadata else None
                    if value not in (None, [], ()):
                        values[field.name] = _parsed(field, value)
                given[name] = kind(**values)
            command(**given)
        except OfParameter as error:
            text = str(error)
            for name, flag in flags.items():
                text = text.replace(f"`{name}`", flag)
            error.args = (text,)
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
        from uwblink.output import check_apart

        outputs = {name: given[name] for name in WRITTEN if isinstance(given.get(name), Path)}
        others = (
            value if isinstance(value, list | tuple) else [value] for n, value in given.items() if n not in outputs
        )
        check_apart(outputs, [one for values in others for one in values if isinstance(one, Path)])
        command(**given)

    return run


def epilog(*examples: str) -> str | None:
    """Return examples as an epilog, a line each; None without any."""
    heads = ["Example:" if len(examples) == 1 else "Examples:"]
    return "\n".join([*heads, *(f"  {plain(one)}" for one in examples)]) if examples else None


def plain(text: str) -> str:
    """Return a text with its markup escaped; rich is loaded only if there is a bracket."""
    if "[" not in text:
        return text
    from rich.markup import escape

    return escape(text)


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
        return starting(incomplete, (form.format(tag) for tag in _tags(map(Path, ctx.args))))

    return complete


def _tags(paths: Iterable[Path]) -> list[int]:
    from uwblink import Recording, UwblinkError

    found: set[int] = set()
    for path in paths:
        try:
            with Recording.open(path) as recording:
                found |= {tag.tag for tag in recording.tags()}
        except UwblinkError:  # completion does not report errors
            continue
    return sorted(found)
