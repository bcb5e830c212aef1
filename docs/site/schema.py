"""Reference pages out of the JSON Schema of a file: every key with its description, unit, default and range."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, Final

UNITS: Final = {
    "_per_min": "a minute",
    "_mm_per_k": "mm/K",
    "_cm_per_v": "cm/V",
    "_ppm_per_k": "ppm/K",
    "_ppm_per_db": "ppm/dB",
    "_ppm_per_s": "ppm/s",
    "_ppm_per_sqrt_s": "ppm/√s",
    "_ppm_sqrt_s": "ppm·√s",
    "_db_per_m": "dB/m",
    "_mps2_per_sqrt_hz": "m/s²/√Hz",
    "_dps_per_sqrt_hz": "°/s/√Hz",
    "_dps": "°/s",
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_dbm": "dBm",
    "_db": "dB",
    "_ppm": "ppm",
    "_hz": "Hz",
    "_uus": "UWB µs",
    "_us": "µs",
    "_ns": "ns",
    "_ps": "ps",
    "_ms": "ms",
    "_rad": "rad",
    "_deg": "°",
    "_mm": "mm",
    "_cm": "cm",
    "_m": "m",
    "_s": "s",
    "_c": "°C",
    "_k": "K",
    "_v": "V",
}
BRANCHES: Final = ("anyOf", "oneOf")
LONGEST_DEFAULT: Final = 60
RAISED: Final = str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True, slots=True)
class Place:
    """A table of the file: where it stands, the name of its model in the schema, and its discriminator's value."""

    path: str
    model: str
    also: list[str] = field(default_factory=list)


def unit_of(key: str) -> str:
    """Return the unit that a key ends with, or ""."""
    fitting = [suffix for suffix in UNITS if key.endswith(suffix)]
    return UNITS[max(fitting, key=len)] if fitting else ""


def reference(schema: dict[str, Any], root: str) -> str:
    """Return the Markdown of every table of a file: a definition list a table, in the order of the models."""
    return "\n".join(_section(schema, place, root) for place in _places(schema, root))


def described(schema: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield model, key and description ("" where there is none) of every key of a schema."""
    models = {schema.get("title", ""): schema} | schema.get("$defs", {})
    for model, table in models.items():
        for key, value in table.get("properties", {}).items():
            yield model, key, value.get("description", "")


def _places(schema: dict[str, Any], root: str) -> list[Place]:
    """Return every table once, depth first, with all the places where it can stand."""
    found: dict[str, Place] = {root: Place("", root)}

    def visit(table: dict[str, Any], path: str) -> None:
        for key, value in table.get("properties", {}).items():
            for model, listed in _refs(value):
                below = ".".join(filter(None, (path, f"{key}[]" if listed else key)))
                if model in found:
                    found[model].also.append(below)
                    continue
                found[model] = Place(below, model)
                visit(schema["$defs"][model], below)

    visit(schema, "")
    return list(found.values())


def _refs(value: dict[str, Any], *, listed: bool = False) -> Iterator[tuple[str, bool]]:
    """Yield the models that a key can hold, and whether as items of a list."""
    if "$ref" in value:
        yield value["$ref"].rsplit("/", 1)[-1], listed
    for branch in BRANCHES:
        for choice in value.get(branch, ()):
            yield from _refs(choice, listed=listed)
    if isinstance(value.get("items"), dict):
        yield from _refs(value["items"], listed=True)


def _section(schema: dict[str, Any], place: Place, root: str) -> str:
    table = schema if place.model == root else schema["$defs"][place.model]
    lines = [f"## {_title(table, place)}", "", table.get("description", ""), ""]
    also = [path for path in dict.fromkeys(place.also) if path != place.path]
    if also:
        lines += ["Also at " + ", ".join(f"`{path}`" for path in also) + ".", ""]
    required = table.get("required", [])
    for key, value in table.get("properties", {}).items():
        lines += [f"`{key}`", f": {value.get('description', '')}", "", f"  *{_facts(key, value, required)}*", ""]
    return "\n".join(lines)


def _title(table: dict[str, Any], place: Place) -> str:
    if not place.path:
        return "The file"
    which = [f'{key} = "{value["const"]}"' for key, value in table.get("properties", {}).items() if "const" in value]
    return f"`{place.path}`" + (f": `{which[0]}`" if which else "")


def _facts(key: str, value: dict[str, Any], required: list[str]) -> str:
    """Return kind, unit, default and range of a key, in words."""
    facts = [_kind(value), unit_of(key), _range(value)]
    if key in required:
        facts.append("needed")
    elif "default" in value:
        facts.append(f"default {_shown(value['default'])}")
    return "; ".join(filter(None, facts))


def _shown(default: Any) -> str:
    if default is None:
        return "none"
    text = json.dumps(default, ensure_ascii=False)
    return f"`{text}`" if len(text) <= LONGEST_DEFAULT else "as the table below has them"


def _number(value: float) -> str:
    """Return a limit: powers of ten as such."""
    size = abs(value)
    if size < 1e5 or not math.log10(size).is_integer():
        return f"{value:g}"
    return ("-" if value < 0 else "") + "10" + str(round(math.log10(size))).translate(RAISED)


def _kind(value: dict[str, Any]) -> str:
    if "const" in value:
        return f"`{json.dumps(value['const'])}`"
    if "enum" in value:
        return "one of " + ", ".join(f"`{json.dumps(choice)}`" for choice in value["enum"])
    if "$ref" in value:
        return "table"
    for branch in BRANCHES:
        if branch in value:
            kinds = [_kind(choice) for choice in value[branch] if choice.get("type") != "null"]
            return " or ".join(dict.fromkeys(kinds))
    return _list_kind(value) if value.get("type") == "array" else str(value.get("type", "anything"))


def _list_kind(value: dict[str, Any]) -> str:
    items = value.get("prefixItems")
    if items:
        return f"{len(items)} × {' or '.join(dict.fromkeys(_kind(item) for item in items))}"
    return f"list of {_kind(value.get('items', {}))}s".replace("`s", "`")


def _range(value: dict[str, Any]) -> str:
    """Return the range of a number, of itself or of the number among its choices or items."""
    if "enum" in value or "const" in value:
        return ""
    for branch in BRANCHES:
        for choice in value.get(branch, ()):
            if choice.get("type") in ("number", "integer", "array"):
                return _range(choice)
    if value.get("type") == "array":
        items = value.get("prefixItems") or [value.get("items", {})]
        return _range(items[0]) if items[0].get("type") in ("number", "integer", "array") else ""
    low, high = value.get("minimum", value.get("exclusiveMinimum")), value.get("maximum")
    if low is None and high is None:
        return ""
    lowest = "above" if "exclusiveMinimum" in value else "from"
    ends = [f"{lowest} {_number(low)}" if low is not None else "", f"to {_number(high)}" if high is not None else ""]
    return " ".join(filter(None, ends))
