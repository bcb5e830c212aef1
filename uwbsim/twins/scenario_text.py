"""Tables of a scenario as TOML text."""

from __future__ import annotations

import json
import textwrap
from collections.abc import Mapping
from typing import Any, Final

WIDTH: Final = 120
DIGITS: Final = 8


def scenario_text(table: Mapping[str, Any], head: str) -> str:
    """Return a scenario file: a comment, and a table each; what is one line is written as one."""
    parts = ["\n".join(f"# {line}" for line in textwrap.wrap(head, WIDTH - 2))]
    for name, section in table.items():
        if isinstance(section, list):
            parts += [f"[[{name}]]\n{_lines(one)}" for one in section]
        else:
            short = {key: value for key, value in section.items() if not _is_long(value)}
            parts.append(f"[{name}]\n{_lines(short)}{_tables(name, section)}")
    return "\n\n".join(parts) + "\n"


def _lines(section: Mapping[str, Any]) -> str:
    return "\n".join(f"{key} = {_value(value)}" for key, value in section.items())


def _tables(name: str, section: Mapping[str, Any]) -> str:
    return "".join(f"\n\n[{name}.{key}]\n{_lines(value)}" for key, value in section.items() if _is_long(value))


def _is_long(value: Any) -> bool:
    return isinstance(value, Mapping) and len(_value(value)) > WIDTH // 2


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, float):
        return _number(value)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_value(one)}" for key, one in value.items()) + " }"
    if isinstance(value, list | tuple):
        return _listed([_value(one) for one in value])
    return str(value)


def _number(value: float) -> str:
    """Return a number with as many digits as there can be meaning in, and a point."""
    text = f"{value:.{DIGITS}g}"
    return text if "." in text or "e" in text else f"{text}.0"


def _listed(values: list[str]) -> str:
    line = f"[{', '.join(values)}]"
    if len(line) <= WIDTH:
        return line
    return "[\n" + textwrap.indent("\n".join(_wrapped(values)), "  ") + "\n]"


def _wrapped(values: list[str]) -> list[str]:
    """Return lines of values; a value that is long itself has one of its own."""
    lines, line = [], ""
    for value in values:
        if len(line) + len(value) + 2 > WIDTH - 2 and line:
            lines.append(line.rstrip())
            line = ""
        line += f"{value}, "
    return [*lines, line.rstrip()]
