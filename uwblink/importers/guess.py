"""Propose a map for a table, a log or a bag, with the reason for each line.

The form of the file is recognised first (`forms`), then its columns by their names, or else by their contents. Units
are determined from suffixes of the names, from the size of the numbers, and by which unit of the stamps makes plausible
ranges; the protocol is found by trying all.

Topics of a bag with one message type that differ by one or two numbers or words, such as `/uwb/1/range_2` and
`/uwb/1/range_3`, are a template; the different part is the id of an initiator or a target. The words before it, and the
ids in the messages themselves, determine which of both. The first messages are read as a table.
"""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice, product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import duckdb
import numpy as np

from uwblink.arrays import Columns, Floats
from uwblink.display import first_few
from uwblink.errors import ImportTableError, raising, restating
from uwblink.importers.bags import Bag, fields_of, is_bag, matching_topics, open_bag
from uwblink.importers.column_map import (
    ALL_IDS,
    ASKED,
    DISTANCE_UNITS,
    IDS,
    JSON_LINE,
    NAMES,
    POSITIONS,
    POWERS,
    SIGN,
    STAMP_UNITS,
    ColumnMap,
)
from uwblink.importers.exchange_tables import tables_in
from uwblink.importers.forms import (
    NOT_READ,
    OF_MESSAGES,
    WORDS,
    Entries,
    form_of,
    name_template,
    named_columns,
    plain_name,
    register_columns,
    unit_in,
    units_in,
    units_of,
    wide_columns,
)
from uwblink.importers.plausibility import (
    ACCEPTED_SHARE,
    FITTING_SHARE,
    SAMPLE_ROWS,
    Reading,
    counter_format,
    sentinels,
    stamps_of,
    truth_m,
    try_reading,
)
from uwblink.importers.poses import pose_topics
from uwblink.importers.tables import SourceTable, connected, message_number
from uwblink.importers.templates import Template, places
from uwblink.protocols.table import PROTOCOLS
from uwblink.text_files import require_regular
from uwblink.twr import STAMPS


def with_stamp_and_event(table: SourceTable, columns: dict[str, str]) -> dict[str, str]:
    """Return the columns of a table with a stamp and its event in each row; the same columns for another table.

    If several columns are times, the stamp is the one whose name mentions a device, or else does not mention the host.
    """
    if all(name in columns for name in STAMPS[:4]) or ("tx" in columns and "rx" in columns):
        return columns
    single = {name: plain_name(name) for name in table.names if table.names.count(name) == 1}
    kinds = r"(event|direction|dir|kind|type|action|edge|what|tx_?or_?rx|tx_?rx)"
    clock = rf"((device|dw|dw1000|raw|chip|uwb)_?)?(stamp|timestamp|time|ticks?|counter|t){WORDS['end']}"
    event = next(
        (name for name, plain in single.items() if re.fullmatch(kinds, plain) and _is_event(table, name)), None
    )
    times = [name for name, plain in single.items() if re.fullmatch(clock, plain)]
    if event is None or not times:
        return columns

    def unlikely(name: str) -> tuple[bool, bool]:
        of_device = re.search(r"device|dw|tick|dtu|raw|chip|counter|^stamp", single[name])
        return not of_device, bool(re.search(r"host|ros|unix|utc|iso|date|time_s$", single[name]))

    stamp = min(times, key=unlikely)
    rest = {ours: header for ours, header in columns.items() if header not in (stamp, event)}
    if "time_s" not in rest and len(times) > 1:
        rest["time_s"] = next(name for name in times if name != stamp)
    return rest | {"stamp": stamp, "event": event}


def _is_event(table: SourceTable, name: str) -> bool:
    """Return whether a column has words for transmission and for reception, about equally often."""
    word = f"lower(trim({table.text(name)}))"
    sent = f"{word} IN ('tx', 't', 'sent', 'send', 'transmit', 'transmitted')"
    received = f"{word} IN ('rx', 'r', 'received', 'receive', 'recv')"
    shares = table.read({"sent": f"avg(({sent})::INT)", "received": f"avg(({received})::INT)"})
    sending, receiving = (float(np.ma.filled(share, 0.0)[0]) for share in shares.values())
    return sending + receiving > 0.9 and 0.25 < sending < 0.75


def _receptions(short: Mapping[str, str], each: str, found: Mapping[str, str]) -> dict[str, str]:
    """Return further columns of broadcasts whose senders list earlier receptions; none for other tables.

    `short` are the columns by their names, for elements of the list `each` by the names of their fields.
    """
    if found.get("tx", f"{each}.").startswith(f"{each}."):
        return {}
    number, stamp = r"(.*_)?(sn|seq|sequence|number|nr|no)", r"(.*_)?(ts|rx|stamp|timestamp|ticks?)"
    inner = {name: plain_name(name) for name, header in short.items() if header.startswith(f"{each}.")}
    outer = {name: plain_name(name) for name in short if name not in inner}
    wanted = {"sequence": (number, outer), "heard": (number, inner), "rx": (stamp, inner)}
    columns = {
        ours: short[name]
        for ours, (pattern, names) in wanted.items()
        if (name := next((n for n, plain in names.items() if re.fullmatch(pattern, plain)), None))
    }
    return columns if columns.keys() == wanted.keys() else {}


_LAYOUTS: Final = {
    "exchanges": (STAMPS[:4], "a row has the stamps of a whole exchange"),
    "broadcasts": (("tx", "rx", "sequence", "heard"), "broadcasts have lists of what their senders heard"),
    "messages": (("tx", "rx"), "a row has one stamp of a sender and one of a receiver"),
    "stamps": (("message",), "a row has one stamp, and a word for transmission or reception"),
    "ranges": (("range_m",), "there are ranges and no stamps"),
    "differences": (("difference_m",), f"{SIGN}: exchange the two if it is not"),
    "nothing": ((), "neither stamps nor ranges were recognised: name their columns below"),
}
"""The layouts that are recognised: required columns, and the reason."""


@dataclass(frozen=True, slots=True)
class Guess:
    """A map as TOML text with reasons as comments, and whether it is sufficient to import the table.

    `asked` are keys that the table does not determine: the map has "?" there, which the user must replace.
    """

    text: str
    complete: bool
    asked: tuple[str, ...] = ()
    columns: tuple[str, ...] = ()
    importer: str = "csv"
    pose_topics: tuple[str, ...] = ()
    advice: str = ""
    """Remark on calibrations without true distances, for bags without poses."""


def guess_map(path: Path) -> Guess:
    """Return the proposed map of a table, a log, a folder of them, or a bag; raises `ImportTableError`."""
    if path.suffix.lower() == ".uwb":
        raise ImportTableError(f"{path}: is a recording already and needs no map; 'uwblink show' prints its contents")
    file = tables_in(path, ColumnMap(line="{*}"))[0] if path.is_dir() and not is_bag(path) else path
    return _map_of_bag(path) if is_bag(path) else _map_of_table(path, file)


def _map_of_table(path: Path, file: Path, given: Collection[str] = (), meanings: Mapping[str, str] = {}) -> Guess:
    """Return the map of a table by its name, `path` or a part of it.

    `given` are columns with names of `NAMES`, `meanings` recognisable names of columns.
    """
    require_regular(file, ImportTableError, "table")
    with connected([file]) as db:
        return _map_of_connected_table(db, path, file, given, meanings)


def _map_of_connected_table(
    db: duckdb.DuckDBPyConnection, path: Path, file: Path, given: Collection[str], meanings: Mapping[str, str]
) -> Guess:
    """Return the map of a table, which is opened again in each form that its columns indicate."""
    form, top = form_of(file)
    table = SourceTable(db, file, form)
    if form.headerless:
        return _numbered(path, table)
    is_log = form.line not in (None, JSON_LINE)
    columns = {} if is_log else with_stamp_and_event(table, named_columns(table.names))
    wide = form.wide or wide_columns(table.names, columns)
    if each := None if is_log or wide or "range_m" in columns else next(iter(table.lists), None):
        top["each"] = each, "a line has a list of them"
    given = {*given, *(n for text in (form.line, form.each) if text for n in places(Template(text)) if n in NAMES)}
    given |= {"to_id", *wide, *(["from_id"] if "{from_id}" in str(wide) else [])} if wide else set()
    form = replace(form, wide=wide, each=form.each or each, units=form.units | ({"time": "ns"} if is_bag(path) else {}))
    table = SourceTable(db, file, form, 1)
    # Fields of the elements of a list have their own names.
    short = {name.removeprefix(f"{form.each}."): name for name in table.names}
    short |= {meaning: name for name, meaning in meanings.items() if name in short}
    found = with_stamp_and_event(table, {ours: short[name] for ours, name in named_columns(short).items()})
    for ours, letters in (("to_id", ("id", "A", "a", "addr")), ("range_m", ("R", "r", "D", "d"))) if form.each else ():
        if ours not in found and (letter := next((name for name in letters if name in short), None)):
            found[ours] = short[letter]
    found |= _receptions(short, form.each, found) if form.each else {}
    columns = {name: name for name in given}
    columns |= {
        ours: header
        for ours, header in found.items()
        if ours not in given and header not in given and not re.match(r"[rap]\.", header)
    }
    if "range_m" not in columns:
        # Columns called tx and rx are stamps of messages, unless a row is a range.
        columns = {n: header for n, header in columns.items() if n not in IDS or header not in ("tx", "rx")}
    if template := name_template(file.name, {"from_id", "to_id", "gt_range_m"} - columns.keys()):
        top["from_name"] = template, "by the names of the files"
        form = replace(form, from_name=template)
    table = SourceTable(db, file, form, 2)
    columns |= named_columns(places(Template(template))) if template else {}
    cells = table.numbers({header for name, header in columns.items() if name != "event"}, limit=100_000)
    if "message" in columns:
        number = {"message": message_number(table.text(columns["message"]))}
        cells |= {columns["message"]: np.ma.filled(table.read(number, "LIMIT 100000")["message"], np.nan)}
    return _proposal(path, form, top, given, columns, cells, table.names)


def _numbered(path: Path, table: SourceTable) -> Guess:
    """Return the map of a table without a header; the user has to number its columns."""
    first = ", ".join(f"{k} = {word[:20]}" for k, word in table.words_at(table.names, [0])[0].items())
    wanted = ("time_s", *IDS, "range_m")
    why = "write the number of the column, or delete the line; constants are for what the table lacks"
    lines = _lines({name: (ASKED, why if name == wanted[0] else "") for name in wanted})
    head = f"# {_toml(path.name)} has no header; the columns of its first row are: {_toml(first)[1:-1]}"
    return Guess("\n".join([head, "[columns]", *lines]) + "\n", True, wanted)


def _proposal(
    path: Path,
    form: ColumnMap,
    top: Entries,
    given: Collection[str],
    columns: dict[str, str],
    numbers: Mapping[str, Floats],
    names: Sequence[str],
) -> Guess:
    """Return the map of a table of a form; `given` are columns that need no name, `numbers` the cells by header."""
    cells = {name: numbers[header] for name, header in columns.items() if name != "event"}
    if not len(next(iter(cells.values()), np.empty(0))):
        raise ImportTableError(f"{path}: no column whose name is known, or no rows; there are {', '.join(names)}")
    missing: dict[float, float] = {}
    for name in ("range_m", "gt_range_m"):
        if name in cells:
            missing |= sentinels(cells[name])
            cells[name] = np.where(np.isin(cells[name], list(missing)), np.nan, cells[name])
    words = {name for name, column in cells.items() if not np.isfinite(column).any()}
    known = (one for one, (needed, _) in _LAYOUTS.items() if one != "stamps" and {*needed} <= cells.keys())
    layout = "stamps" if "event" in columns else next(known)
    if layout == "nothing" and {"qw", "qx", "qy", "qz"} <= {name.lower() for name in names}:
        raise ImportTableError(f"{path}: contains poses, not ranges; add them to a recording with `uwblink poses`")
    (needed, why), foreign = _LAYOUTS[layout], NOT_READ.get(layout, OF_MESSAGES)
    if layout == "messages" and "message" in words and columns["message"] != "message":
        del columns["message"], cells["message"]  # without a column of that name the order of messages is used
    top |= {} if layout == "nothing" else {"layout": (layout, why)}
    units, undelayed = units_of(form, columns, cells), False
    if layout not in ("ranges", "differences", "nothing"):
        with restating(ImportTableError, ImportTableError, where=f"{path}: "):
            counter, unit, undelayed = (_exchange_stamps if layout == "exchanges" else _message_stamps)(columns, cells)
        top, units = top | counter, {"stamps": unit, **units}
    if missing:
        shares = ", ".join(f"{share:.1%} are {value:.10g}" for value, share in missing.items())
        listed = [int(value) if value == int(value) else value for value in missing]
        top["missing"] = listed, f"of the distances {shares}, which are none"
    registers = register_columns([name for name in names if name not in columns.values()])
    registers = {(ours if layout == "messages" else f"{ours}2"): keys for ours, keys in registers.items()}
    registers = {ours: keys for ours, keys in registers.items() if ours not in columns}
    top |= {"chip": (ASKED, "powers from registers: write dw1000 or dw3000"), "prf": (64, "MHz")} if registers else {}
    used = {name: header for name, header in columns.items() if name not in foreign}
    sections: dict[str, Entries] = {
        "": top,
        "columns": _named(layout, used, given, words, names) | {ours: (keys, "") for ours, keys in registers.items()},
        "wide": {ours: (stated, "") for ours, stated in form.wide.items()},
        "units": units,
        "constants": _constants(layout, columns),
        "antenna_delays": _NO_DELAYS if undelayed else {},
    }
    lacking = [name for name in needed if name not in cells or name in words]
    lacking += ["message"] if layout == "messages" and "message" in words & cells.keys() else []
    unplaced = [name for name in POSITIONS if name not in columns]
    taken = {*used.values(), *(header for keys in registers.values() for header in keys.values())}
    left = [_toml(name) for name in names if name not in taken and not form.line and not form.wide]
    remarks = {
        why: layout == "nothing",
        "antenna delays programmed into the devices are unknown: give them in [antenna_delays]": not undelayed,
        f"positions need all six columns; missing: {', '.join(unplaced)}": 0 < len(unplaced) < 6,
        f"not used: {', '.join(left)[:300]}": left,
        f"a column of numbers is still needed: {', '.join(lacking)}": lacking,
    }
    text = _text(path, sections, [text for text, is_due in remarks.items() if is_due])
    entries = (entry for title in ("constants", "", "columns", "units") for entry in sections[title].items())
    asked = tuple(name for name, (value, _) in entries if value == ASKED)
    return Guess(text, layout != "nothing" and not lacking, asked, tuple(columns))


_NO_DELAYS: Final[Entries] = {
    "tx": (0, "according to the true distances, none were programmed into the devices"),
    "rx": (0, ""),
}


def _constants(layout: str, columns: Mapping[str, str]) -> Entries:
    """Return the ids without a column, which the user must give."""
    why = "no column was recognised as {}: write a number or a word for all rows, or the column above"
    ids = ALL_IDS if layout == "differences" else IDS
    return {name: (ASKED, why.format(meaning)) for name, meaning in ids.items() if name not in columns}


def _named(
    layout: str, used: Mapping[str, str], given: Collection[str], words: Collection[str], names: Sequence[str]
) -> Entries:
    """Return the `used` columns that need a name, "?" where the user must choose; `words` have no numbers."""
    named: Entries = {name: (header, "") for name, header in used.items() if name not in given}
    if layout == "nothing" and not {*STAMPS} & used.keys():
        named["range_m"] = (ASKED, "write the column of the ranges; or delete this line, and name those of stamps")
    elif layout == "ranges" and "range_m" in named and (kinds := _kinds_of_range(used["range_m"], names)):
        named["range_m"] = (ASKED, f"write the column that the device measured: {' or '.join(map(_toml, kinds))}")
    if "gt_range_m" in words and "gt_range_m" in named:
        missing = f"{_toml(used['gt_range_m'])} has no numbers: name a column, or delete the line"
        named["gt_range_m"] = (ASKED, missing)
    return named


def _text(path: Path, sections: Mapping[str, Entries], remarks: Iterable[str]) -> str:
    """Return a map as TOML, a section without a title first, and remarks below it."""
    # Names of files can have line breaks, which would end the comment.
    lines = [f"# {_toml(path.name)}, as it would be read; every line can be changed"]
    for title, entries in sections.items():
        lines += [*(["", f"[{title}]"] if title else []), *_lines(entries)] if entries else []
    return "\n".join([*lines, "", *(f"# {text}" for text in remarks), ""])


def _kinds_of_range(header: str, names: Sequence[str]) -> list[str]:
    """Return the columns of ranges of different kinds, such as raw and filtered, if there are several."""
    made = re.compile(rf"(^|_){WORDS['made']}(?=_|$)")
    bare = {name: made.sub("", plain_name(name)).strip("_") for name in names}
    found = [name for name in names if bare[name] == bare[header]]
    return found if len(found) > 1 else []


def _lines(entries: Entries) -> list[str]:
    return [f"{key} = {_toml(value)}" + (f"  # {why}" if why else "") for key, (value, why) in entries.items()]


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return f"{{{', '.join(f'{key} = {_toml(one)}' for key, one in value.items())}}}"
    # JSON may write a letter as two surrogates, which TOML does not have.
    return "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in json.dumps(value, ensure_ascii=False))


StampEntries = tuple[Entries, tuple[str, str], bool]
"""Protocol and counter, the unit of stamps with its reason, and whether no antenna delays were programmed."""

_ANY_UNIT: Final = f"unit unknown: write {', '.join(STAMP_UNITS)}"


def _message_stamps(columns: dict[str, str], cells: dict[str, Floats]) -> StampEntries:
    """Return the reading of stamps of a table of messages or of single stamps."""
    stamps: dict[str, Floats] = {name: cells[name] for name in ("tx", "rx", "stamp") if name in cells}
    named = next(iter(units_in(columns, stamps, STAMP_UNITS)), None)
    bits, kind = counter_format(column * STAMP_UNITS[named or "ticks"] for column in stamps.values())
    largest = max(float(np.nanmax(column, initial=0.0)) for column in stamps.values())
    # In nine tables of ten with 22 stamps in ticks, at least one stamp is in the last tenth of the counter.
    full = _are_whole(stamps) and 0.9 * 2.0**bits < largest < 2.0**bits
    counter: Entries = {"bits": (bits, ""), "counter": (kind, "")}
    unit = ("ticks", f"whole numbers up to 2^{bits}") if full else (ASKED, _ANY_UNIT)
    return counter, (named, "by the names of the columns") if named else unit, False


def _exchange_stamps(columns: dict[str, str], cells: dict[str, Floats]) -> StampEntries:
    """Return the reading of stamps of a table of exchanges: the protocol and unit with plausible ranges."""
    stamps: dict[str, Floats] = {name: cells[name] for name in STAMPS if name in cells}
    whole, named = _are_whole(stamps), units_in(columns, stamps, STAMP_UNITS)
    chosen = np.flatnonzero(np.all([np.isfinite(column) for column in stamps.values()], axis=0))[:SAMPLE_ROWS]
    if not len(chosen):
        raise ImportTableError("its stamps are no numbers in any row")
    rows: Columns = {name: column[chosen] for name, column in stamps.items()}
    rows |= dict.fromkeys(("origin", *IDS), np.zeros(len(chosen), np.int64))
    if "gt_range_m" in cells:
        rows["gt_range_m"] = (
            cells["gt_range_m"][chosen] * DISTANCE_UNITS[unit_in(columns["gt_range_m"], DISTANCE_UNITS) or "m"]
        )
    protocols = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) == set(stamps)]
    protocols = [name for name in protocols if name not in ("ss-cfo", "ds-sym")] or ["ss"]
    undelayed = (False, True) if np.isfinite(truth_m(rows)).any() else (False,)
    trials = []
    for unit in sorted(named) or (["ticks", "ns", "us", "s", "ps"] if whole else ["ns", "us", "s", "ps"]):
        scale = STAMP_UNITS[unit]
        bits, kind = counter_format(rows[name] * scale for name in stamps)
        for without, name in product(undelayed, protocols):
            reading = Reading(name, bits, undelayed=without)
            trials.append((unit, kind, try_reading(rows, ColumnMap(units={"stamps": unit}), reading)))
    unit, kind, best = max(trials, key=lambda found: round(found[2].plausible, 2))
    known = best.plausible >= ACCEPTED_SHARE
    check = "" if best.plausible >= FITTING_SHARE else "; check columns and units"
    share = f"{100 * best.plausible:.0f} % of its ranges are plausible, {best}{check}"
    counter: Entries = {
        "protocol": (best.reading.protocol if known else ASKED, share),
        "bits": (best.reading.bits, "the stamps fit"),
        "counter": (kind, ""),
    }
    why = "by the columns' names" if named else "whole numbers" if whole else "as ranges are plausible"
    return counter, (unit, why) if known or named else (ASKED, _ANY_UNIT), best.reading.undelayed


def _are_whole(stamps: dict[str, Floats]) -> bool:
    return all(np.array_equal(column, np.rint(column), equal_nan=True) for column in stamps.values())


_NUMBERS: Final = r"std_msgs/msg/(Float|U?Int)[0-9]+(MultiArray)?"
_OTHERS: Final = (
    r"^((geometry|nav|tf2|rosgraph|diagnostic|visualization|actionlib)_msgs|rcl_interfaces)/|"
    r"^sensor_msgs/msg/(?!Range )|"
    rf"^{_NUMBERS} (?!.*(uwb|rang(e|ing)|dist|dwm?[0-9]|twr))|"
    r" .*(height|altitude|lidar|laser|sonar|sonic|infrared|rangefinder|distance_sensor)"
)
"""Types and topics, with a blank between, of other data, and of numbers that are not named as ranges."""

_WORD: Final = "([^/_]+)"
_WORDS: Final = {
    "from_id": r"tag|drone|uav|robot|rover|mobile|initiator|agent|from|src|source",
    "to_id": r"anchor|anker|target|responder|beacon|dst",
}


def _map_of_bag(path: Path) -> Guess:
    """Return the map of the topics with the most recognised columns: stamps and powers, then ids.

    Raises `ImportTableError` for a bag without ranges.
    """
    found: list[tuple[Guess, list[str]]] = []
    why = "write a map with [topics]"
    with open_bag(path) as bag, TemporaryDirectory(prefix="uwblink-") as folder:
        kinds = dict(sorted(bag.kinds.items()))
        fitting = [t for t, k in kinds.items() if not re.search(_OTHERS, f"{k} {t.lower()}")]
        for kind in dict.fromkeys(kinds[topic] for topic in fitting):
            for pattern, some in _grouped([topic for topic in fitting if kinds[topic] == kind]):
                try:
                    guess = _guess_topics(bag, pattern, some, Path(folder) / "messages.jsonl")
                    found += [(guess, some)] if guess.complete else []
                except ImportTableError as error:
                    # Most topics have other data; only a type without definition may contain ranges.
                    why = str(error) if "has no definition" in str(error) else why
    listed = [f"{_toml(topic)} ({kind})" for topic, kind in kinds.items()]
    if not found:
        raise ImportTableError(f"{path}: no topic with ranges was recognised in {first_few(listed, 20)}; {why}")
    best, chosen = max(
        found, key=lambda one: (len({*STAMPS, *POWERS} & {*one[0].columns}), -len(one[0].asked), len(one[0].columns))
    )
    poses = pose_topics(path)
    advice = ""
    if not poses and not {"gt_range_m", *POSITIONS} & {*best.columns}:
        advice = (
            "no poses and no true distances: ranges only determine delays of boards that stood still (`calib "
            "survey`); a flight also needs attitudes, and anchors or first positions (calib.fit_from_ranges); "
            "constants of pairs need true distances (docs/without-motion-capture.md)"
        )
    others = [_toml(topic) for _, some in found if some is not chosen for topic in some]
    remarks = ["topics of the bag:", *(f"  {one}" for one in listed)]
    remarks += [f"other topics with ranges, which need their own maps: {', '.join(others)}"] if others else []
    remarks += [f"poses, for `uwblink poses`: {first_few(map(_toml, poses))}"] if poses else []
    text = best.text + "".join(f"# {line}\n" for line in (*remarks, advice) if line)
    return replace(best, text=text, importer="bag", pose_topics=tuple(poses), advice=advice)


def _guess_topics(bag: Bag, pattern: str, topics: list[str], table: Path) -> Guess:
    """Return the map of topics of one type by their first messages, which are written as a table."""
    kind, read = bag.kinds[topics[0]], islice(bag.messages(topics), 2000)  # a judgement
    rows = [(topic, fields_of(kind, message)) for topic, _, _, message in read]
    free = _ends_without_field(rows[0][1] if rows else {})
    key = _with_places(pattern, topics[0], free)
    ids = matching_topics(key, topics)
    # One id may be in the names of all topics.
    whole = name_template(topics[0], set(free) - ids[topics[0]].keys()) or topics[0]
    constants = matching_topics(whole, topics[:1]).get(topics[0], {})
    ids = {topic: {**places, **constants} for topic, places in ids.items()}
    # A template that also matches topics of other types is not usable as a key.
    stated = {key: constants} if len(matching_topics(key, bag.kinds)) == len(topics) else ids
    with raising(ImportTableError, f"{bag.path}: cannot be turned into a table", OSError, RecursionError):
        lines = (json.dumps(_unstamped(row) | ids[topic], allow_nan=False) for topic, row in rows)
        table.write_text("".join(f"{line}\n" for line in lines), "utf-8")
    guess = _map_of_table(bag.path, table, ids[topics[0]], {"data": "range"} if re.fullmatch(_NUMBERS, kind) else {})
    sections = [
        "\n".join([f"[topics.{_toml(topic)}]", *(f"{name} = {_toml(v)}" for name, v in values.items()), ""])
        for topic, values in stated.items()
    ]
    return replace(guess, text=f"{guess.text}\n# {len(topics)} topics of {kind}\n{''.join(sections)}\n")


def _unstamped(row: dict[str, Any]) -> dict[str, Any]:
    """Return a message without the stamp of its header, which is the default time."""
    header = row.get("header")
    return row | {"header": {**header, "stamp": {}}} if isinstance(header, dict) else row


def _grouped(topics: Sequence[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield groups of topics that differ by one or two numbers, or else words, with a format of their names; then the
    others.
    """
    braces, left = ([topic for topic in topics if ("{" in topic) == has] for has in (True, False))
    for value in (r"([0-9]+)", _WORD):
        alike: dict[tuple[str, ...], list[str]] = {}
        for topic in left:
            alike.setdefault(tuple(re.split(value, topic)[::2]), []).append(topic)
        for literals, some in alike.items():
            columns = [set(column) for column in zip(*(re.findall(value, topic) for topic in some), strict=True)]
            varying = [k for k, column in enumerate(columns) if len(column) > 1]
            both, words = [columns[k] for k in varying], {re.split("[^A-Za-z]", literals[k])[-1] for k in varying}
            # Number 1 of a tag is not number 1 of an anchor; in pairs of words, some have a common word.
            mixed = len(words) > 1 and both[0] & both[-1]
            apart = len(both) == 2 and value == _WORD and all(len(column) == len(some) for column in both)
            if not 1 <= len(varying) <= 2 or mixed or apart:
                continue
            parts = re.split(value, some[0])
            for n, k in enumerate(varying):
                parts[2 * k + 1] = f"{{{n}}}"
            left = [topic for topic in left if topic not in some]
            yield "".join(parts), some
    yield from ((topic, [topic]) for topic in (*left, *braces))


def _ends_without_field(row: Mapping[str, Any]) -> list[str]:
    """Return which of the two ids a message lacks; lists and arrays have a target in each element."""
    lists = [value for value in row.values() if isinstance(value, list)]
    elements = [one for value in lists for one in value[:1] if isinstance(one, dict)]
    named = {*named_columns(row), *(name for one in elements for name in named_columns(one))}
    arrays = [f"{name}.{k}" for name, value in row.items() if isinstance(value, dict) for k in value]
    if wide_columns(arrays, {}) or any({"id", "A", "a", "addr"} & one.keys() for one in elements):
        named.add("to_id")
    return [end for end in IDS if end not in named]


def _with_places(pattern: str, topic: str, free: Sequence[str]) -> str:
    """Return the template of topics, whose places are ids in `free`; `topic` is one of them."""
    parts = re.split(r"\{[01]\}", pattern)
    values = re.fullmatch("([^/]+?)".join(map(re.escape, parts)), topic)
    if len(parts) == 1 or values is None:
        return topic
    contexts = [part.rstrip("/").split("/")[-1] + value for part, value in zip(parts, values.groups(), strict=False)]
    ends = [next((end for end in IDS if re.search(_WORDS[end], text.lower())), "") for text in contexts]
    if len(ends) == 2:
        ends = list(IDS)[::-1] if ends[0] == "to_id" or ends[1] == "from_id" else list(IDS)
    elif ends[0] not in free:
        ends = list(free[-1:])
    if len(free) == 1:  # number 1 of a tag is not number 1 of the anchors in the messages
        pattern = re.sub(r"[A-Za-z]+\{", "{", pattern)
    return pattern.format(*(f"{{{end if end in free else '_'}}}" for end in [*ends, "_"]))
