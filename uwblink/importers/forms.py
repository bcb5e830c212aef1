"""Recognise the form of a file for `uwblink import guess`: logs, tables without a header, wide ones, names of files."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any, Final

from uwblink.importers.column_map import ASKED, JSON_LINE, ColumnMap, map_of_lines
from uwblink.importers.column_names import PATTERNS, WORDS, plain_name
from uwblink.importers.lines import LINES
from uwblink.importers.tables import detect, lacks_header, object_in, open_file, reading
from uwblink.importers.templates import Template

Entries = dict[str, tuple[Any, str]]
"""Values of a map by key, each with its reason."""


def form_of(path: Path) -> tuple[ColumnMap, Entries]:
    """Return what a map has to state so that a file is read as a table, and its entries with their reasons."""
    if path.name.lower().removesuffix(".gz").endswith((".parquet", ".jsonl", ".ndjson", ".json")):
        return ColumnMap(), {}
    return _log(path) or (ColumnMap(headerless=lacks_header(detect(path, ColumnMap())[0])), {})


def _log(path: Path) -> tuple[ColumnMap, Entries] | None:
    """Return the form of a log by the templates of its first lines, with a time before them if there is one."""
    with reading(path), open_file(path) as file:
        lines = [line.decode("latin-1").rstrip("\r\n") for line in islice(file, 400)]
    # Boards begin to print at different times, and in the middle of lines.
    if 5 * sum(map(bool, map(object_in, lines))) > sum(map(bool, lines)):
        return ColumnMap(line=JSON_LINE), {"line": (JSON_LINE, "lines that end with an object of JSON")}
    found: dict[str, list[re.Match[str]]] = {}
    for name, known in LINES.items():
        pattern = re.compile(Template(known["line"]).pattern)
        matches = [match for line in lines if (match := pattern.search(line))]
        if matches and len(matches) >= min(3, sum(bool(line.strip()) for line in lines)):
            found[name] = matches
    if not found:
        return None
    name, matches = next(iter(found.items()))
    form, line = map_of_lines(name), LINES[name]["line"]
    leads = [match.string[: match.start()] for match in matches]
    time = r"\W*?([0-9]+(?:\.[0-9]+)?|[0-9]{4}-[0-9-]{5}[ T][0-9:.,]+Z?|[0-9]+:[0-9]{2}:[0-9.]+)(\W+)"
    times = [re.fullmatch(time, lead) for lead in leads]
    if all(times) and (first := times[0]):
        line = f"{leads[0][: first.start(1)]}{{time_s}}{first[2]}{line}"
    both = ASKED, "ranges before and after the board's correction: write trek-raw or trek-corrected"
    entries: Entries = {"line": both if {"trek-raw", "trek-corrected"} <= found.keys() else (line, f"as {name}")}
    entries |= {"each": (form.each, "")} if form.each else {}
    return replace(form, line=line), entries


_DEVICE: Final = r"(an|anchor|anker|a|node|beacon|bs|responder|target|to|device|dev|uwb|id|ch)"
_HELD: Final = ("range_m", "gt_range_m", "fpp2", "rxp2", "skew2")


def wide_columns(names: Sequence[str], taken: Mapping[str, str]) -> dict[str, str | dict[str, str]]:
    """Return the families of columns that differ by the number of a device, as the values of `wide`.

    `taken` are recognised columns; a table with ranges or stamps in them is not wide.
    """
    if any(ours in taken for ours in ("range_m", "tx1", "rx1", "tx", "rx", "stamp")):
        return {}
    ends = [taken[ours] for ours in ("from_id", "to_id", "time_s") if ours in taken]
    matches = (re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", name) for name in names if name not in ends)
    stems = [(match[1], match[3]) for match in matches if match]
    found: dict[str, str | dict[str, str]] = {}
    for before, after in dict.fromkeys(stem for stem in stems if stems.count(stem) > 1):
        plain = plain_name(f"{before} {after}")
        bare = re.sub(rf"(^|_){_DEVICE}(?=_|$)", "", plain)
        # Without words of devices nothing but a unit may remain.
        short = r"|(r|d|dis|dis_arr(ay)?|data|ranges|distances|dists)" + ("|" if bare != plain else "")
        for ours in _HELD:
            pattern = f"_?({PATTERNS[ours]}{short if ours == 'range_m' else ''}){{end}}".format_map(WORDS)
            if ours not in found and re.fullmatch(pattern, bare):
                found[ours] = f"{before}{{to_id}}{after}"
                break
    return found if "range_m" in found else {}


_REGISTERS: Final = {
    "f1": r"fp_?ampl?(itude)?_?1|f1",
    "f2": r"fp_?ampl?(itude)?_?2|f2",
    "f3": r"fp_?ampl?(itude)?_?3|f3",
    "n": r"rx_?pacc(_?nosat)?|preamble_?(acc(um)?_?)?count|acc(um)?_?count",
    "c": r"cir_?(pwr|power)",
    "d": r"dgc(_?decision)?",
}


def register_columns(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the powers that can be made of registers, as their values in a map, by "fpp" and "rxp"."""
    plain = {name: plain_name(name) for name in names}
    found = {
        key: header
        for key, pattern in _REGISTERS.items()
        if (header := next((name for name, one in plain.items() if re.fullmatch(pattern, one)), None))
    }
    wanted = {"fpp": ("f1", "f2", "f3", "n"), "rxp": ("c", "n")}
    powers = {ours: {key: found[key] for key in keys} for ours, keys in wanted.items() if set(keys) <= found.keys()}
    return {ours: keys | ({"d": found["d"]} if "d" in found else {}) for ours, keys in powers.items()}


_ID: Final = r"[_\- ]?)(?P<v>[0-9]+|[A-Z](?![a-z]))"
_VALUES: Final = {
    "from_id": r"(?i:(?<![a-z0-9])(?:tag|initiator|from|src|source|mobile|rover|robot)" + _ID,
    "to_id": r"(?i:(?<![a-z0-9])(?:anchor|an|to|dst|dest|target|responder|beacon)" + _ID,
    "gt_range_{}": r"(?<![0-9.])(?P<v>[0-9]+(?:\.[0-9]+)?)_?(?P<unit>mm|cm|m)(?![a-z])",
    "gt_range": r"(?i:(?<![a-z])(?:dist(?:ance)?|gt|true|truth|range)[_\- ]?)(?P<v>[0-9]+(?:\.[0-9]+)?)",
}
"""What names of files say, by place; a true distance with or without its unit."""


def name_template(name: str, lacking: Collection[str]) -> str | None:
    """Return a template of a file's name with the columns that a table lacks; None if it names none."""
    text, found = re.sub("[{}]", "", name), set[str]()
    for place, pattern in _VALUES.items():
        ours = "gt_range_m" if place.startswith("gt") else place
        if ours in lacking and ours not in found and (match := re.search(pattern, text)):
            start, end = match.span("v")
            text = f"{text[:start]}{{{place.format(match.groupdict().get('unit'))}}}{text[end:]}"
            found.add(ours)
    return text if found else None
