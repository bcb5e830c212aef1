"""Recognise forms and units for `uwblink import guess`: logs, tables without a header, wide ones, names of files.

Names of columns are English and German, as in files of laboratories; `PATTERNS` maps them to `NAMES`.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import islice, product
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.importers.column_map import (
    ASKED,
    DISTANCES,
    FLIGHT_UNITS,
    JSON_LINE,
    POSITIONS,
    POWERS,
    TEMPERATURES,
    TIME_UNITS,
    UNITS_BY_KEY,
    ColumnMap,
)
from uwblink.importers.devices import LINES
from uwblink.importers.plausibility import MIN_ROWS, reason_against_dbm, reason_against_metres
from uwblink.importers.tables import detect, lacks_header, object_in, opened
from uwblink.importers.templates import Template
from uwblink.twr import STAMPS

OF_MESSAGES: Final = ("tx", "rx", "fpp", "rxp", "skew", "sts", "sequence", "message")
OF_EXCHANGES: Final = (*STAMPS, "fpp1", "fpp2", "rxp1", "rxp2", "skew1", "skew2", "sts1", "sts2", *TEMPERATURES)

NOT_READ: Final = {
    "exchanges": OF_MESSAGES,
    "broadcasts": (*OF_EXCHANGES, "fpp", "rxp", "skew", "sts"),
    "messages": OF_EXCHANGES,
    "stamps": OF_EXCHANGES,
    "ranges": (*OF_MESSAGES, *STAMPS),
    "differences": (*OF_MESSAGES, *TEMPERATURES, *STAMPS, "range_m"),
}
"""The columns that are not read, by layout."""

WORDS: Final = {
    "end": (
        r"(_(raw|ts|stamp|timestamp|time|ticks?|dtu|ps|ns|us|ms|s|sec|m|mm|cm|ft|in|meters?|metres?|"
        r"dbm|db|ppm))*"
    ),
    "id": r"(_?(id|addr|address|mac|name))?",
    "device": (
        r"(tag|node|device|dev|board|robot|agent|anchor|module|modul|radio|unit|uwb|id|addr|address|"
        r"mac|geraet|knoten)"
    ),
    "range": r"(range|dist|distance|abstand|distanz|entfernung|tof|time_?of_?flight)",
    "difference": r"(\b|_)(tdoa|dtoa)|(range|dist(ance)?)_?diff|\bdifference",
    "measured": r"(measured?|gemessene?r?)",
    "made": r"(raw|filt(er)?(ered)?|corrected|corr|kalman|smooth(ed)?)",
    "true": (
        r"(gt|true|truth|ground_?truth|ref|reference|nominal|mocap|vicon|actual|tape(_?measured?)?|"
        r"laser|soll|wahre?r?|referenz)"
    ),
    "fpp": (
        r"(fpp?|(fp|first_?path)_?(power|pwr|rssi|level|leistung)|first_?path|(rssi|power|leistung)_?(fp|first_?path))"
    ),
    "rxp": (
        r"(rxp|rx_?(power|pwr|level|dbm)|rssi|total_?power|pr|signal_?(level|strength|staerke)|"
        r"(empfangs_?|signal_?)?pegel|empfangs_?leistung)"
    ),
    "skew": r"(skew|cfo|carrier|clock_?offset)",
    "sts": r"sts(_?(q|qual|quality))?(_?(idx|index))?",
    "temperature": r"(temp(eratur(e)?)?|t_?celsius)(_?(deg_?)?c(elsius)?)?",
    "of_time": r"((t|ts|time|stamp|timestamp|zeit)_)?",
    "from": r"(from|src|source|initiator|tag|my|sender|tx|requester|robot|rover|mobile|node_?a|id_?1)",
    "to": r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|beacon|node_?b|id_?2)",
}
"""Words in patterns."""


def _place(name: str) -> str:
    """Return the pattern of a column of `POSITIONS`, for names such as `tag_x`, `anchor_pos_x_m`, `x_tag` and `x1`.

    A plain `x` belongs to the initiator, which is the moving device if the others are called anchors.
    """
    end, axis = name.split("_")[:2]
    words, number = WORDS[end], 1 if end == "from" else 2
    true, place = r"((gt|true|truth|ground_?truth|mocap|ref)_?)?", r"(pos(ition)?|loc(ation)?|place|p)?"
    forms = [rf"{true}{words}_?{place}_?{axis}", rf"{true}{place}_?{axis}_?({words}|{number})", rf"p{number}_?{axis}"]
    forms += [rf"{true}{place}_?{axis}"] if end == "from" else []
    return "|".join(forms)


PATTERNS: Final = {
    "time_s": (
        r"(ros_?|host_?|unix_?|utc_?|mess_?)?"
        r"(time|timestamp|stamp|t|datetime|date(_?time)?|epoch|zeit|zeitstempel|uhrzeit|datum)(_(utc|iso))?"
    ),
    "from_id": r"(from|src|source|initiator|tag|my|sender|tx|requester|node_?a|quelle|von|id_?(from|von)|id_?1){id}",
    "to_id": (
        r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|node_?b|ziel|an|nach|anker|"
        r"empf(ae|a)nger|id_?(to|an|nach)|id_?2){id}"
    ),
    "tx1": r"{of_time}(tx_?1|t_?1|poll_?(tx|sent)|tx_?poll)",
    "rx1": r"{of_time}(rx_?1|t_?2|poll_?(rx|received)|rx_?poll)",
    "tx2": r"{of_time}(tx_?2|t_?3|resp(onse)?_?(tx|sent)|tx_?resp(onse)?)",
    "rx2": r"{of_time}(rx_?2|t_?4|resp(onse)?_?(rx|received)|rx_?resp(onse)?)",
    "tx3": r"{of_time}(tx_?3|t_?5|(final|report)_?(tx|sent)|tx_?(final|report))",
    "rx3": r"{of_time}(rx_?3|t_?6|(final|report)_?(rx|received)|rx_?(final|report))",
    "fpp1": r"{fpp}_?1",
    "fpp2": r"{fpp}_?2?",
    "rxp1": r"{rxp}_?1",
    "rxp2": r"{rxp}_?2?",
    "skew1": r"{skew}_?1",
    "skew2": r"{skew}_?2?",
    "sts1": r"{sts}_?1",
    "sts2": r"{sts}_?2?",
    "gt_range_m": r"{true}_?{range}?|{range}_?{true}",
    "range_m": r"({made}_?|device_?|{measured}_?|uwb_?|est(imated)?_?)?{range}(_?({made}|{measured}))?|{measured}",
    "sequence": r"(seq|sequence|exchange|laufnummer)(_?(no|num|nr|number|id))?",
    "message": r"(msg|message|frame|nachricht)(_?(no|num|nr|number|type|id))?",
    "from_temperature_c": (
        r"((device_?)?({from}|von|a|i)_?)?{temperature}|{temperature}_?(at_|of_)?({from}|von|a|i)(_c)?"
    ),
    "to_temperature_c": r"(device_?)?({to}|nach|b|j|r)_?{temperature}|{temperature}_?(at_|of_)?({to}|nach|b|j|r)(_c)?",
    "tx": r"tx",
    "rx": r"rx",
    "fpp": r"{fpp}",
    "rxp": r"{rxp}",
    "skew": r"{skew}",
    "sts": r"{sts}",
} | {name: _place(name) for name in POSITIONS}
"""Patterns of the names of columns, in terms of `WORDS`."""

_OF_DIFFERENCES: Final = PATTERNS | {
    "time_s": rf"{PATTERNS['time_s']}|t_?tdoa",
    "difference_m": r".*({difference}).*",
    "at_id": r"(at|tag|listener|robot|drone|mobile|receiver|rx|ziel){id}",
    "from_id": r"((anchor|anker|node)_?)?(from|minus|src|source){id}",
    "to_id": r"((anchor|anker|node)_?)?(to|plus|dst|target){id}",
}
"""Patterns of names in tables of differences of arrival, whose ids have other roles than ids of ranges."""

_OF_MESSAGE: Final = {"poll": 1, "resp": 2, "response": 2}
_AT_DEVICE: Final = {"resp": 1, "responder": 1, "target": 1, "anchor": 1, "init": 2, "initiator": 2, "tag": 2}


def plain_name(header: str) -> str:
    """Return a name in lower case without accents, its words joined by `_`: `first_path_1_dbm`."""
    spelled = header.translate({ord("ß"): "ss", ord("µ"): "u", ord("μ"): "u"})  # the micro sign, and the Greek letter
    bare = unicodedata.normalize("NFKD", spelled).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", bare.lower()).strip("_")


def _plain_names(headers: Iterable[str]) -> dict[str, str]:
    """Return plain names by header; powers and skews get the number of their message: `fp_power_init` is `fp_power_2`.

    `resp` means the responding device if another column names the initiator, else the response message.
    """
    level = "(?P<level>{fpp}|{rxp}|{skew}|{sts})".format_map(WORDS)
    end, whose = WORDS["end"], "|".join(sorted({*_OF_MESSAGE, *_AT_DEVICE}, key=len)[::-1])
    forms = (rf"{level}_(at_|of_)?(?P<whose>{whose})(?P<end>{end})", rf"(?P<whose>{whose})_{level}(?P<end>{end})")
    names = {header: plain_name(header) for header in headers}
    matches = {h: re.fullmatch(forms[0], name) or re.fullmatch(forms[1], name) for h, name in names.items()}
    ends = {match["whose"] for match in matches.values() if match}
    numbers = _AT_DEVICE | _OF_MESSAGE | ({"resp": 1, "response": 1} if ends & {"init", "initiator", "tag"} else {})
    return names | {h: f"{m['level']}_{numbers[m['whose']]}{m['end']}" for h, m in matches.items() if m}


def named_columns(headers: Iterable[str]) -> dict[str, str]:
    """Return the header of each recognised column; raw columns come before others, then earlier ones first."""
    listed = sorted(headers, key=lambda header: "raw" not in header.lower())
    called = _plain_names(listed)
    found, words = _ends(called), " ".join(called.values())
    differ = re.search(WORDS["difference"], words) is not None
    for ours, pattern in (_OF_DIFFERENCES if differ else PATTERNS).items():
        whole = f"({pattern}){{end}}".format_map(WORDS)
        # Each column is used once, except names of messages, which may repeat names of exchanges at this stage.
        taken = {header for name, header in found.items() if (name in OF_MESSAGES) == (ours in OF_MESSAGES)}
        free = (header for header in listed if listed.count(header) == 1 and header not in taken)
        if header := next((header for header in free if re.fullmatch(whole, called[header])), None):
            found[ours] = header
    return found


def _ends(called: dict[str, str]) -> dict[str, str]:
    """Return the columns of the two devices if their names differ by a letter, as `node_i` and `node_j`."""
    letters = (("a", "b"), ("i", "j"), ("1", "2"), ("0", "1"), ("one", "two"))
    for both, form in product(letters, ("{0}_?{1}", "{0}{2}_{1}", "{0}_?{1}{2}")):
        patterns = [form.format(WORDS["device"], letter, WORDS["id"]) for letter in both]
        ends = [[header for header, name in called.items() if re.fullmatch(one, name)] for one in patterns]
        stems = [{called[header][:2] for header in headers} for headers in ends]
        if all(len(headers) == 1 for headers in ends) and stems[0] == stems[1]:
            return {"from_id": ends[0][0], "to_id": ends[1][0]}
    return {}


Entries = dict[str, tuple[Any, str]]
"""Values of a map by key, each with its reason."""


def form_of(path: Path) -> tuple[ColumnMap, Entries]:
    """Return the entries of a map that are needed to read a file as a table, with their reasons."""
    if path.name.lower().removesuffix(".gz").endswith((".parquet", ".jsonl", ".ndjson", ".json")):
        return ColumnMap(), {}
    return _log(path) or (ColumnMap(headerless=lacks_header(detect(path, ColumnMap())[0])), {})


def _log(path: Path) -> tuple[ColumnMap, Entries] | None:
    """Return the form of a log by the templates of its first lines, with a time before them if there is one."""
    with opened(path) as file:
        # The time of a search grows with the square of a line's length; no board prints 10,000 letters in one.
        lines = [line[:10_000].decode("latin-1").rstrip("\r\n") for line in islice(file, 400)]
    # Boards start to print at different times, and in the middle of lines.
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
    form, line = ColumnMap(**LINES[name]), LINES[name]["line"]
    leads = [match.string[: match.start()] for match in matches]
    time = r"\W*?([0-9]+(?:\.[0-9]+)?|[0-9]{4}-[0-9-]{5}[ T][0-9:.,]+Z?|[0-9]+:[0-9]{2}:[0-9.]+)(\W+)"
    times = [re.fullmatch(time, lead) for lead in leads]
    if all(times) and (first := times[0]):
        line = f"{leads[0][: first.start(1)]}{{time_s}}{first[2]}{line}"
    both = ASKED, "ranges before and after the board's correction: write trek-raw or trek-corrected"
    entries: Entries = {"line": both if {"trek-raw", "trek-corrected"} <= found.keys() else (line, f"as {name}")}
    entries |= {"each": (form.each, "")} if form.each else {}
    return replace(form, line=line), entries


def wide_columns(names: Sequence[str], taken: Mapping[str, str]) -> dict[str, str | dict[str, str]]:
    """Return the families of columns that differ by the number of a device, as the values of `wide`.

    `taken` are recognised columns; a table with ranges or stamps in them is not wide.
    """
    if any(ours in taken for ours in ("range_m", "tx1", "rx1", "tx", "rx", "stamp")):
        return {}
    if pairs := [match[1] for name in names if (match := re.fullmatch(r"(.*\bd|.*tdoa.*?)[0-9]+-[0-9]+", name))]:
        return {"difference_m": f"{pairs[0]}{{from_id}}-{{to_id}}"}
    ends = [taken[ours] for ours in ("from_id", "to_id", "time_s") if ours in taken]
    matches = (re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", name) for name in names if name not in ends)
    stems = [(match[1], match[3]) for match in matches if match]
    found: dict[str, str | dict[str, str]] = {}
    device = r"(^|_)(an|anchor|anker|a|node|beacon|bs|responder|target|to|device|dev|uwb|id|ch)(?=_|$)"
    for before, after in dict.fromkeys(stem for stem in stems if stems.count(stem) > 1):
        plain = plain_name(f"{before} {after}")
        bare = re.sub(device, "", plain)
        # Without words for devices only a unit may remain.
        short = r"|(r|d|dis|dis_arr(ay)?|data|ranges|distances|dists)" + ("|" if bare != plain else "")
        for ours in ("range_m", "gt_range_m", "fpp2", "rxp2", "skew2"):
            pattern = f"_?({PATTERNS[ours]}{short if ours == 'range_m' else ''}){{end}}".format_map(WORDS)
            if ours not in found and re.fullmatch(pattern, bare):
                found[ours] = f"{before}{{to_id}}{after}"
                break
    return found if "range_m" in found else {}


def register_columns(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the powers that can be computed from registers, as values of a map, by "fpp" and "rxp"."""
    called = {f"f{k}": rf"fp_?ampl?(itude)?_?{k}|f{k}" for k in (1, 2, 3)} | {
        "n": r"rx_?pacc(_?nosat)?|preamble_?(acc(um)?_?)?count|acc(um)?_?count",
        "c": r"cir_?(pwr|power)",
        "d": r"dgc(_?decision)?",
    }
    found = {
        key: header
        for key, pattern in called.items()
        if (header := next((name for name in names if re.fullmatch(pattern, plain_name(name))), None))
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
"""Patterns of values in names of files, by place; a true distance with or without its unit."""


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


def units_of(form: ColumnMap, columns: dict[str, str], cells: dict[str, Floats]) -> Entries:
    """Return the units of times, distances and powers, each with its reason, as far as they are not the default."""
    found: Entries = {}
    if "time_s" in columns:
        found["time"] = _time_unit(columns["time_s"], cells["time_s"])
        if found["time"][0] == ASKED and "time" in form.units:
            found["time"] = form.units["time"], "as times in bags"
    named = {name: _header(form, name, columns[name]) for name in DISTANCES if name in columns}
    units = {name: unit for name, header in named.items() if (unit := unit_in(header, UNITS_BY_KEY[name]))}
    alike, value = set(units.values()), "difference_m" if "difference_m" in cells else "range_m"
    if form.line and "distance" in form.units:
        found["distance"] = form.units["distance"], "as these boards print"
    elif len(alike) == 1 and not alike & FLIGHT_UNITS.keys() and (value in units or value not in cells):
        found["distance"] = next(iter(units.values())), "by the columns' names"
        units = {}
    elif value in cells and value not in units and (why := reason_against_metres(cells[value])):
        listed = ", ".join(UNITS_BY_KEY[value])
        found["distance" if value == "range_m" else value] = ASKED, f"{why}: write {listed}"
    found |= {name: (unit, "by the column's name") for name, unit in units.items()}
    if "range_m" in named and "range_m" not in units and re.search("tof|flight", named["range_m"].lower()):
        found["range_m"] = ASKED, f"a time of flight: write {', '.join(FLIGHT_UNITS)}"
    if why := next(filter(None, (reason_against_dbm(cells[name]) for name in POWERS if name in cells)), ""):
        found["power"] = ASKED, f"{why}: write -dBm if they lack their sign"
    return found


def _header(form: ColumnMap, name: str, header: str) -> str:
    """Return the name of a column in the file; for a family its template."""
    stated = form.wide.get(name)
    return re.sub(r"[_ ]*\{\w+\}", "", stated) if isinstance(stated, str) else header


def _time_unit(header: str, values: Floats) -> tuple[str, str]:
    if not np.isfinite(values).any():
        return "iso", "no numbers"
    if ended := unit_in(header, ("ns", "us", "ms", "s")):
        return ended, "by the column's name"
    largest = float(np.nanmax(np.abs(values)))
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if largest > least:
            return unit, f"{largest:.3g} would be no date in seconds"
    if len(values) < MIN_ROWS or not np.array_equal(values, np.rint(values), equal_nan=True):
        return "s", f"numbers up to {largest:.6g}"
    return ASKED, f"whole numbers up to {largest:.6g}, unit unknown: write {', '.join(TIME_UNITS)}"


def units_in(columns: dict[str, str], names: Iterable[str], units: Iterable[str]) -> set[str]:
    """Return the units at the ends of the headers of some columns."""
    return {unit for name in names if name in columns and (unit := unit_in(columns[name], units))}


def unit_in(header: str, units: Iterable[str]) -> str | None:
    """Return the unit at the end of a name such as `range_mm` or `time [ns]`, None without one."""
    last = plain_name(header).split("_")[-1]
    last = {"tick": "ticks", "dtu": "ticks", "sec": "s"}.get(last, last)
    return last if last in units and last != header.lower() else None
