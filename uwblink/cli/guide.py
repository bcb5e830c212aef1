"""Help of commands: examples, panels, completion, and options that are made of settings."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import Field, fields, is_dataclass
from functools import wraps
from inspect import Parameter, Signature, signature
from pathlib import Path
from typing import Annotated, Any, Final, get_type_hints

import typer

from uwblink.cli.options import Command
from uwblink.errors import OfParameter
from uwblink.settings import flags_of

WRITTEN: Final = ("output", "pdf", "figures", "report", "tum", "plot")
"""Parameters of commands that name what is written; all other paths are read."""


def add(
    app: typer.Typer,
    command: Callable[..., None],
    *examples: str,
    panel: str | None = None,
    name: str | None = None,
    renamed: Mapping[str, str] | None = None,
) -> None:
    """Register a command in a panel of the list of commands, with examples below its own help.

    A parameter that is a dataclass of settings (`uwblink.settings`) becomes one option per field, and errors name its
    fields by their options. `renamed` maps old
    names of options to what the command answers: "--old is now --new".
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
    """Return the value of a field from what was typed; an error of parsing names the field."""
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
    # Where they do not fit in their column of 20 letters (of 80), they are broken between names.
    return {"metavar": together if len(together) <= 20 else " | ".join(names), "autocompletion": complete}


def several(names: Callable[[], Iterable[str]]) -> dict[str, Any]:
    """Return what `typer.Option` takes for names with commas between, whose last one is completed."""

    def complete(incomplete: str) -> list[str]:
        before, comma, last = incomplete.rpartition(",")
        taken = set(before.split(","))
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
        except UwblinkError:  # completion does not report errors
            continue
    return sorted(found)
