"""Templates of lines and of file names: literal text with places for columns, compiled to regular expressions.

`Range: {range_m} m` finds a number after the text. A place is `{name}`; `{name:hex}` and `{name:int}` take only digits;
`{name[8]}` is a list of up to eight values, which become the columns `name.0` to `name.7`; `{_}` is not used, and `{*}`
is any text. The expressions use common syntax of RE2 and Python's `re`. DuckDB applies them with RE2, whose time is
linear in the text, so an untrusted template cannot stall an import.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Final

_PLACE: Final = re.compile(r"\{(?P<name>\w+|\*)(?:\[(?P<count>\d{1,2})\])?(?::(?P<form>hex|int))?\}")
_VALUES: Final = {
    "": r"(?:[0-9]{4}-[0-9]{2}-[0-9]{2}[ T][0-9:.,]+(?:Z|[+-][0-9:]+)?|[^\s,;()\[\]{}=]*)",
    "hex": "[0-9A-Fa-f]+",
    "int": "[0-9]+",
    "list": r"[^()\[\]{}=]*",
    "_": r"[^\s,;()\[\]{}=]*?",
    "*": ".*?",
}
"""Expressions of values by the form of a place; the first is a time with a blank in it, or text without a blank."""


@dataclass(frozen=True)
class Template:
    """A template; `text` is what the user wrote, and `is_template` is true for it."""

    text: str

    @property
    def _places(self) -> list[tuple[str, str, int]]:
        """Name, form and number of values (0: one) of each place that is used."""
        found = ((m["name"], m["form"] or "", int(m["count"] or 0)) for m in _PLACE.finditer(self.text))
        return [place for place in found if place[0] not in ("_", "*")]

    @cached_property
    def pattern(self) -> str:
        """The regular expression, a group a place. Blanks match any number of blanks; after commas and colons they may
        be missing.
        """
        parts, end = list[str](), 0
        for place in _PLACE.finditer(self.text):
            name, form = place["name"], "list" if place["count"] else place["form"] or ""
            value = _VALUES[name if name in ("_", "*") and not form else form]
            parts += [_literal(self.text[end : place.start()]), value if name in ("_", "*") else f"({value})"]
            end = place.end()
        return "".join([*parts, _literal(self.text[end:]), "" if self._places else "()"])

    def columns(self, groups: str) -> dict[str, str]:
        """Return SQL of the columns by name; `groups` is a struct as `regexp_extract` returns it."""
        found: dict[str, str] = {}
        for k, (name, form, count) in enumerate(self._places):
            group = f"{groups}.g{k}"
            values = f"string_split_regex(trim({group}), '[,;[:space:]]+')"
            found |= {f"{name}.{n}": f"{values}[{n + 1}]" for n in range(count)}
            if not count:
                found[name] = f"TRY_CAST('0x' || {group} AS BIGINT)" if form == "hex" else group
        return found

    def extract(self, text: str, pattern: str) -> str:
        """Return SQL of the groups in an SQL text; `pattern` is SQL of the pattern."""
        listed = ", ".join(f"'g{k}'" for k in range(max(1, len(self._places))))
        return f"regexp_extract({text}, {pattern}, [{listed}])"

    def match(self, text: str) -> dict[str, str] | None:
        """Return the values at the end of a path or a topic, by place, without slashes; None if it does not match."""
        found = re.search(f"(?:^|/){self.pattern.replace('[^', '[^/')}$", text)
        return dict(zip((name for name, _, _ in self._places), found.groups(), strict=False)) if found else None


def is_template(text: str) -> bool:
    """Return whether braces are places of different columns."""
    named = [place["name"] for place in _PLACE.finditer(text) if place["name"] not in ("_", "*")]
    return not re.search(r"[{}]", _PLACE.sub("", text)) and len(set(named)) == len(named)


def places(template: Template) -> list[str]:
    """Return the names of the columns that are places."""
    return list(template.columns("_"))


def _literal(text: str) -> str:
    """Return the expression of literal text; a letter outside ASCII matches any such letters, in any encoding."""
    parts = re.findall(r"\s+|[^\x00-\x7f]+|[,:]\s*|.", text)
    return "".join(
        r"\s+"
        if part.isspace()
        else "[^ -~]+"
        if part > "\x7f"
        else f"{part[0]}\\s*"
        if part[0] in ",:"
        else re.escape(part)
        for part in parts
    )
