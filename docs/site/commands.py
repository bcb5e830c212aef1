"""Reference pages of the commands out of their Typer apps: what `--help` says, as text that fits narrow screens."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Any

import typer
from rich.text import Text

VALUES = {"Path": "PATH", "str": "TEXT", "int": "NUMBER", "float": "NUMBER"}


def reference(app: typer.Typer, name: str) -> str:
    """Return the Markdown of every command of an app: usage, what it does, examples, arguments and options."""
    group: Any = typer.main.get_command(app)
    return "\n".join(_section(words, command) for words, command in leaves(group, (name,)))


def leaves(group: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every command below a group that does something, with the words that call it."""
    context = group.make_context(words[-1], [], resilient_parsing=True)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        if hasattr(command, "list_commands"):
            yield from leaves(command, (*words, name))
        else:
            yield (*words, name), command


def _section(words: Sequence[str], command: Any) -> str:
    called = " ".join(words)
    lines = [
        f"## `{called}`",
        "",
        _plain(command.help),
        "",
        "```text",
        f"{called} {_usage(command)}".rstrip(),
        "```",
        "",
    ]
    examples = [line.strip() for line in Text.from_markup(command.epilog or "").plain.splitlines()[1:]]
    if examples:
        lines += [
            "<!-- not run: tests/test_help.py holds that it parses -->",
            "```sh",
            *filter(None, examples),
            "```",
            "",
        ]
    shown = [p for p in command.params if not p.hidden and p.name != "help"]
    for panel in dict.fromkeys(p.rich_help_panel for p in shown):
        lines += [f"**{panel}**", ""] if panel else []
        lines += [line for p in shown if p.rich_help_panel == panel for line in (_entry(p), "")]
    return "\n".join(lines)


def _usage(command: Any) -> str:
    """Return the arguments, the options that are needed, and that there are others."""
    arguments = [_argument(p) for p in command.params if type(p).__name__ == "TyperArgument"]
    options = [p for p in command.params if type(p).__name__ != "TyperArgument"]
    needed = [f"{_flags(p)[-1]} {_value(p)}" for p in options if p.required]
    return " ".join([*arguments, *needed, *(["[OPTIONS]"] if options else [])])


def _argument(parameter: Any) -> str:
    name = (parameter.metavar or parameter.name).upper() + ("..." if parameter.nargs == -1 else "")
    return name if parameter.required else f"[{name}]"


def _flags(parameter: Any) -> list[str]:
    return sorted(parameter.opts, key=len) + list(parameter.secondary_opts)


def _value(parameter: Any) -> str:
    if parameter.is_flag:
        return ""
    kind = re.sub(r"^list\[|\]$", "", str(parameter.type_descriptor.annotation)).split(".")[-1].strip("'<>")
    return (parameter.metavar or VALUES.get(kind.removeprefix("class '"), "VALUE")).replace(" ", "")


def _entry(parameter: Any) -> str:
    if type(parameter).__name__ == "TyperArgument":
        head = f"`{_argument(parameter)}`"
    else:
        value = _value(parameter)
        head = ", ".join(f"`{flag}`" for flag in _flags(parameter)) + (f" `{value}`" if value else "")
    facts = []
    if parameter.required:
        facts.append("needed")
    if parameter.default not in (None, False, (), []) and not parameter.required:
        facts.append(f"default `{parameter.default}`")
    tail = f" *({'; '.join(facts)})*" if facts else ""
    return f"{head}\n: {_plain(parameter.help)}{tail}"


def _plain(text: str | None) -> str:
    """Return a help text as Markdown: no markup of the terminal, and what stands in it as it is."""
    plain = Text.from_markup(text or "").plain
    return re.sub(r"([\[\]<>*_|])", r"\\\1", " ".join(plain.split()))
