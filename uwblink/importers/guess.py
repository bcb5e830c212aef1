"""Propose a map for a table, with the reason for each line.

Columns are recognised by their names, English and German ones that labs use, or else by their contents. Units are
determined from suffixes of the names, from the size of the numbers, and by which unit of the stamps makes plausible
ranges; the protocol is found by trying all.
"""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import (
    ASKED,
    DISTANCE_UNITS,
    DISTANCES,
    IDS,
    POSITIONS,
    POWERS,
    STAMP_UNITS,
    TIME_UNITS,
)
from uwblink.importers.plausibility import (
    ACCEPTED_SHARE,
    FITTING_SHARE,
    MIN_ROWS,
    SAMPLE_ROWS,
    Reading,
    Sample,
    Trial,
    counter_format_of,
    reason_against_dbm,
    reason_against_metres,
    stamps_of,
)
from uwblink.importers.tables import Table
from uwblink.protocols.table import PROTOCOLS
from uwblink.twr import STAMPS

OF_MESSAGES: Final = ("tx", "rx", "fpp", "rxp", "skew", "sequence", "message")

_WORDS: Final = {
    "end": (
        r"(_(raw|ts|stamp|timestamp|time|ticks?|dtu|ps|ns|us|ms|s|sec|m|mm|cm|ft|in|meters?|metres?|"
        r"dbm|db|ppm))*"
    ),
    "id": r"(_?(id|addr|address|mac|name))?",
    "device": (
        r"(tag|node|device|dev|board|robot|agent|anchor|module|modul|radio|unit|uwb|id|addr|address|"
        r"mac|geraet|knoten)"
    ),
    "range": r"(range|dist|distance|abstand|distanz|entfernung)",
    "true": (
        r"(gt|true|truth|ground_?truth|ref|reference|nominal|mocap|vicon|actual|tape(_?measured?)?|"
        r"laser|soll|wahr(er)?|referenz)"
    ),
    "fpp": r"(fpp?|(fp|first_?path)_?(power|pwr|rssi|level|leistung)|first_?path)",
    "rxp": r"(rxp|rx_?(power|pwr|level)|rssi|total_?power|pr)",
    "skew": r"(skew|cfo|carrier|clock_?offset)",
    "of_time": r"((t|ts|time|stamp|timestamp|zeit)_)?",
    "from": r"(from|src|source|initiator|tag|my|sender|tx|requester|robot|rover|mobile|node_?a|id_?1)",
    "to": r"(to|dst|dest|destination|target|responder|anchor|neighbou?r|receiver|rx|beacon|node_?b|id_?2)",
}
"""Words that patterns are made of."""


def _place(name: str) -> str:
    """Return the pattern of a column of `POSITIONS`, for names such as `tag_x`, `anchor_pos_x_m`, `x_tag` and `x1`.

    A plain `x` is the initiator's, since the initiator moves if the other devices are called anchors.
    """
    end, axis = name.split("_")[:2]
    words, number = _WORDS[end], 1 if end == "from" else 2
    true, place = r"((gt|true|truth|ground_?truth|mocap|ref)_?)?", r"(pos(ition)?|loc(ation)?|place|p)?"
    forms = [rf"{true}{words}_?{place}_?{axis}", rf"{true}{place}_?{axis}_?({words}|{number})", rf"p{number}_?{axis}"]
    forms += [rf"{true}{place}_?{axis}"] if end == "from" else []
    return "|".join(forms)


_PATTERNS: Final = {
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
    "gt_range_m": r"{true}_?{range}?|{range}_?{true}",
    "range_m": r"(device_?|measured?_?|uwb_?|est(imated)?_?)?{range}",
    "sequence": r"(seq|sequence|exchange|laufnummer)(_?(no|num|nr|number|id))?",
    "message": r"(msg|message|frame|nachricht)(_?(no|num|nr|number|type|id))?",
    "tx": r"tx",
    "rx": r"rx",
    "fpp": r"{fpp}",
    "rxp": r"{rxp}",
    "skew": r"{skew}",
} | {name: _place(name) for name in POSITIONS}
"""Patterns of the names of columns, in terms of `_WORDS`."""

_OF_MESSAGE: Final = {"poll": 1, "resp": 2, "response": 2}
_AT_DEVICE: Final = {"resp": 1, "responder": 1, "target": 1, "anchor": 1, "init": 2, "initiator": 2, "tag": 2}


def _plain(header: str) -> str:
    """Return a name in lower case without accents, its words joined by `_`: `first_path_1_dbm`."""
    bare = unicodedata.normalize("NFKD", header.replace("ß", "ss")).encode("ascii", "ignore").decode()
    return re.sub(r"[^a-z0-9]+", "_", bare.lower()).strip("_")


def _plain_names(headers: Iterable[str]) -> dict[str, str]:
    """Return plain names by header; powers and skews get the number of their message: `fp_power_init` is `fp_power_2`.

    `resp` means the responding device if another column names the initiator, else the response message.
    """
    level = "(?P<level>{fpp}|{rxp}|{skew})".format_map(_WORDS)
    end, whose = _WORDS["end"], "|".join(sorted({*_OF_MESSAGE, *_AT_DEVICE}, key=len)[::-1])
    forms = (rf"{level}_(at_|of_)?(?P<whose>{whose})(?P<end>{end})", rf"(?P<whose>{whose})_{level}(?P<end>{end})")
    names = {header: _plain(header) for header in headers}
    matches = {h: re.fullmatch(forms[0], name) or re.fullmatch(forms[1], name) for h, name in names.items()}
    ends = {match["whose"] for match in matches.values() if match}
    numbers = _AT_DEVICE | _OF_MESSAGE | ({"resp": 1, "response": 1} if ends & {"init", "initiator", "tag"} else {})
    levels = {h: f"{m['level']}_{numbers[m['whose']]}{m['end']}" for h, m in matches.items() if m}
    return names | levels


def named_columns(headers: Iterable[str]) -> dict[str, str]:
    """Return the header of each recognised column; raw columns come before others, then earlier ones first."""
    listed = sorted(headers, key=lambda header: "raw" not in header.lower())
    called = _plain_names(listed)
    found = _ends(called)
    for ours, pattern in _PATTERNS.items():
        whole = f"({pattern}){{end}}".format_map(_WORDS)
        # Each column is used once, but for names of messages, which may repeat those of exchanges at this stage.
        taken = {header for name, header in found.items() if (name in OF_MESSAGES) == (ours in OF_MESSAGES)}
        free = (header for header in listed if listed.count(header) == 1 and header not in taken)
        if header := next((header for header in free if re.fullmatch(whole, called[header])), None):
            found[ours] = header
    return found


def _ends(called: dict[str, str]) -> dict[str, str]:
    """Return the columns of the two devices if their names differ by a letter, as `node_i` and `node_j`."""
    letters = (("a", "b"), ("i", "j"), ("1", "2"), ("0", "1"), ("one", "two"))
    for both, form in product(letters, ("{0}_?{1}", "{0}{2}_{1}", "{0}_?{1}{2}")):
        patterns = [form.format(_WORDS["device"], letter, _WORDS["id"]) for letter in both]
        ends = [[header for header, name in called.items() if re.fullmatch(one, name)] for one in patterns]
        stems = [{called[header][:2] for header in headers} for headers in ends]
        if all(len(headers) == 1 for headers in ends) and stems[0] == stems[1]:
            return {"from_id": ends[0][0], "to_id": ends[1][0]}
    return {}


def stamp_and_event(table: Table, columns: dict[str, str]) -> dict[str, str] | None:
    """Return the columns of a table with one stamp in each row; None without a column of transmissions and receptions.

    If several columns are times, the stamp is the one whose name mentions a device, or else does not mention the host.
    """
    if all(name in columns for name in STAMPS[:4]) or ("tx" in columns and "rx" in columns):
        return None
    single = {name: _plain(name) for name in table.names if table.names.count(name) == 1}
    kinds = r"(event|direction|dir|kind|type|action|edge|what|tx_?or_?rx|tx_?rx)"
    clock = rf"((device|dw|dw1000|raw|chip|uwb)_?)?(stamp|timestamp|time|ticks?|counter|t){_WORDS['end']}"
    event = next(
        (name for name, plain in single.items() if re.fullmatch(kinds, plain) and _is_event(table, name)), None
    )
    times = [name for name, plain in single.items() if re.fullmatch(clock, plain)]
    if event is None or not times:
        return None

    def unlikely(name: str) -> tuple[bool, bool]:
        of_device = re.search(r"device|dw|tick|dtu|raw|chip|counter|^stamp", single[name])
        return not of_device, bool(re.search(r"host|ros|unix|utc|iso|date|time_s$", single[name]))

    stamp = min(times, key=unlikely)
    rest = {ours: header for ours, header in columns.items() if header not in (stamp, event)}
    if "time_s" not in rest and len(times) > 1:
        rest["time_s"] = next(name for name in times if name != stamp)
    return rest | {"stamp": stamp, "event": event}


def _is_event(table: Table, name: str) -> bool:
    """Return whether a column has words for transmission and reception, about equally often."""
    words = np.char.lower(table.read(words=[name])[1][name])
    sent = np.isin(words, ("tx", "t", "sent", "send", "transmit", "transmitted"))
    received = np.isin(words, ("rx", "r", "received", "receive", "recv"))
    return bool(np.mean(sent | received) > 0.9 and 0.25 < np.mean(sent) < 0.75) if len(sent) else False


def unusable_positions(columns: dict[str, str], cells: dict[str, Floats]) -> str:
    """Return why the positions of a table cannot be used; empty text if they can, or if there are none."""
    lacking = [name for name in POSITIONS if name not in columns]
    if len(lacking) == len(POSITIONS):
        return ""
    if lacking:
        return f"positions are used where all six columns are there; missing: {', '.join(lacking)}"
    if "range_m" not in columns:
        return ""
    ends = np.array([cells[name] for name in POSITIONS])
    apart = np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0))
    used = np.isfinite(apart) & (apart > 0) & np.isfinite(cells["range_m"])
    ratio = float(np.median(cells["range_m"][used] / apart[used])) if used.any() else 1.0
    if 0.5 < ratio < 2.0:
        return ""
    return f"positions are left out: ranges are {ratio:.3g} of their distance; distances have one unit"


_ANY_UNIT: Final = f"unit unknown: write {', '.join(STAMP_UNITS)}"
_LAYOUTS: Final = {
    "exchanges": (STAMPS[:4], "a row has the stamps of a whole exchange"),
    "messages": (("tx", "rx"), "a row has one stamp of a sender and one of a receiver"),
    "stamps": (("message",), "a row has one stamp, and says whether it is of sending or of receiving"),
    "ranges": (("range_m",), "there are ranges and no stamps"),
    "nothing": ((), "neither stamps nor ranges were recognised: rename columns below"),
}
"""The layouts that are recognised: the columns that each needs, and how it was recognised."""


@dataclass(frozen=True, slots=True)
class Guess:
    """A map as TOML text with reasons as comments, and whether it is sufficient to import the table.

    `asked` are keys that cannot be determined from the table: the map has "?" there, which the user must replace.
    """

    text: str
    complete: bool
    asked: tuple[str, ...] = ()


def guess_map(path: Path) -> Guess:
    """Return the proposed map of a table; raises `ImportTableError`."""
    if path.suffix.lower() == ".uwb":
        raise ImportTableError(f"{path}: is a recording already and needs no map; 'uwblink show' prints its contents")
    with Table(path) as table:
        columns = named_columns(table.names)
        columns = stamp_and_event(table, columns) or columns
        headers = {name: header for name, header in columns.items() if name != "event"}
        numbers = table.read(numbers=headers.values(), limit=100_000)[0]
    cells = {name: numbers[header] for name, header in headers.items()}
    if not len(next(iter(cells.values()), np.empty(0))):
        raise ImportTableError(f"{path}: no column whose name is known, or no rows; there are {', '.join(table.names)}")
    fitting = (one for one in ("exchanges", "messages", "ranges") if all(name in cells for name in _LAYOUTS[one][0]))
    layout = "stamps" if "event" in columns else next(fitting, "nothing")
    if layout == "messages" and _only_words(cells, "message") and columns["message"] != "message":
        del columns["message"], cells["message"]  # without a column of that name messages are told by their order
    unplaced = unusable_positions(columns, cells)
    for name in POSITIONS if unplaced else ():
        columns.pop(name, None)
        cells.pop(name, None)
    needed, why = _LAYOUTS[layout]
    top = [f"# {why}" if layout == "nothing" else f'layout = "{layout}"  # {why}']
    units, delays = _unit_lines(columns, cells), list[str]()
    if layout in ("exchanges", "messages", "stamps"):
        counter, unit, delays = _stamp_lines(columns, cells, layout)
        top, units = top + counter, [unit, *units]
    missing = [name for name in IDS if name not in columns]
    asked = [*missing, *(line.split()[0] for line in [*top, *units] if f'= "{ASKED}"' in line)]
    left = [name for name in table.names if name not in columns.values()]
    lacking = [name for name in needed if name not in cells or _only_words(cells, name)]
    lacking += ["message"] if layout == "messages" and _only_words(cells, "message") else []
    mixed = _distance_units(columns)
    # Names of files can have line breaks, which would end the comment.
    lines = [f"# {json.dumps(path.name)}, as it would be read; every line can be changed", *top, "", "[columns]"]
    lines += [f"{name} = {json.dumps(header)}" for name, header in columns.items() if _belongs(name, layout)]
    lines += ["", "[units]", *units] if units else []
    lines += ["", "[constants]"] if missing else []
    lines += [
        f'{name} = "{ASKED}"  # no column was recognised as {IDS[name]}: write a number or a word for all rows, or the '
        "column above"
        for name in missing
    ]
    lines += ["", f"# {unplaced}"] if unplaced else []
    lines += ["", f"# not used: {', '.join(map(json.dumps, left))[:300]}"] if left else []
    lines += [f"# a column of numbers is still needed: {', '.join(lacking)}"] if lacking else []
    if len(mixed) > 1:
        lines.append(f"# distances have one unit for all, here they have {', '.join(sorted(mixed))}: convert some")
    lines += delays or [
        "# the table has no antenna delays that were programmed into the devices: give them in [antenna_delays]"
    ]
    return Guess("\n".join(lines) + "\n", layout != "nothing" and not lacking and len(mixed) < 2, tuple(asked))


def _only_words(cells: dict[str, Floats], name: str) -> bool:
    return name in cells and not np.isfinite(cells[name]).any()


def _belongs(name: str, layout: str) -> bool:
    if layout in ("messages", "stamps"):
        return name not in (*STAMPS, "fpp1", "fpp2", "rxp1", "rxp2", "skew1", "skew2")
    return name not in OF_MESSAGES and not (layout == "ranges" and name in STAMPS)


def _stamp_lines(columns: dict[str, str], cells: dict[str, Floats], layout: str) -> tuple[list[str], str, list[str]]:
    """Return the map's lines on protocol and counter, on the unit of stamps, and on antenna delays, with reasons."""
    names = [name for name in (STAMPS if layout == "exchanges" else ("tx", "rx", "stamp")) if name in cells]
    stamps: dict[str, Floats] = {name: cells[name] for name in names}
    whole = all(np.array_equal(column, np.rint(column), equal_nan=True) for column in stamps.values())
    ended = {_suffix(columns[name], STAMP_UNITS) for name in names} - {None}
    if layout != "exchanges":
        named = next(iter(ended), None)
        scale = STAMP_UNITS[named or "ticks"]
        bits, kind = counter_format_of(column * scale for column in stamps.values())
        largest = max(float(np.nanmax(column, initial=0.0)) for column in stamps.values())
        # Of 22 stamps in ticks one at least is in the last tenth of the counter in nine tables of ten.
        full = whole and 0.9 * 2.0**bits < largest < 2.0**bits
        unit = named or ("ticks" if full else ASKED)
        why = "by the columns' names" if named else f"whole numbers up to 2^{bits}" if full else _ANY_UNIT
        return [f"bits = {bits}", f'counter = "{kind}"'], f'stamps = "{unit}"  # {why}', []
    units = sorted(filter(None, ended)) or (
        ["ticks", "ns", "us", "s", "ps"] if whole else ["ns", "us", "s", "ps", "ticks"]
    )
    metres = DISTANCE_UNITS[min(_distance_units(columns), default="m")]
    trials = [trial for unit in units for trial in _trials(stamps, cells, unit, metres)]
    unit, kind, best = max(trials, key=lambda found: round(found[2].plausible, 2))
    known = best.plausible >= ACCEPTED_SHARE
    check = "" if best.plausible >= FITTING_SHARE else "; check columns and units"
    share = f"{100 * best.plausible:.0f} % of its ranges are plausible, {best.low_m:.3g} to {best.high_m:.3g} m{check}"
    lines = [
        f'protocol = "{best.reading.protocol if known else ASKED}"  # {share}',
        f"bits = {best.reading.bits}  # the stamps fit",
        f'counter = "{kind}"',
    ]
    why = "by the columns' names" if ended else "whole numbers" if whole else "as ranges are plausible"
    if not known and not ended:
        unit, why = ASKED, _ANY_UNIT
    delays = [
        "",
        "[antenna_delays]  # by the true distances none were programmed into the devices",
        "tx = 0",
        "rx = 0",
    ]
    return lines, f'stamps = "{unit}"  # {why}', delays if best.reading.undelayed else []


def _trials(
    stamps: dict[str, Floats], cells: dict[str, Floats], unit: str, metres: float
) -> list[tuple[str, str, Trial]]:
    """Try stamps in a unit with each protocol; returns unit, format of the counter, and trial."""
    chosen = np.flatnonzero(np.all([np.isfinite(column) for column in stamps.values()], axis=0))[:SAMPLE_ROWS]
    if not len(chosen):
        raise ImportTableError("its stamps are no numbers in any row")
    sampled, scale, count = {name: column[chosen] for name, column in stamps.items()}, STAMP_UNITS[unit], len(chosen)
    bits, counter = counter_format_of(column * scale for column in sampled.values())
    truth = cells["gt_range_m"][chosen] * metres if "gt_range_m" in cells else np.full(count, np.nan)
    pair, unknown = np.zeros(count, dtype=np.int64), np.full(count, np.nan)
    sample = Sample(sampled, pair, truth, unknown, np.zeros(count), scale)
    names = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) == set(stamps)]
    names = [name for name in names if name not in ("ss-cfo", "ds-sym")] or ["ss"]
    readings = [Reading(name, bits) for name in names]
    if np.isfinite(truth).any():
        readings += [replace(reading, undelayed=True) for reading in readings]
    return [(unit, counter, sample.try_reading(reading)) for reading in readings]


def _unit_lines(columns: dict[str, str], cells: dict[str, Floats]) -> list[str]:
    lines = []
    if "time_s" in columns:
        unit, why = _time_unit(columns["time_s"], cells["time_s"])
        lines.append(f'time = "{unit}"  # {why}')
    units = _distance_units(columns)
    if len(units) == 1:
        lines += [f'distance = "{unit}"  # by the columns\' names' for unit in units]
    elif not units and "range_m" in cells and (why := reason_against_metres(cells["range_m"])):
        lines.append(f'distance = "{ASKED}"  # {why}: write {", ".join(DISTANCE_UNITS)}')
    reasons = [reason_against_dbm(cells[name]) for name in POWERS if name in cells]
    if why := next(filter(None, reasons), ""):
        lines.append(f'power = "{ASKED}"  # {why}: write -dBm if they lack their sign')
    return lines


def _distance_units(columns: dict[str, str]) -> set[str]:
    """Return the units in the names of columns of ranges, true distances and positions."""
    ended = (_suffix(columns[name], DISTANCE_UNITS) for name in DISTANCES if name in columns)
    return {unit for unit in ended if unit}


def _time_unit(header: str, values: Floats) -> tuple[str, str]:
    if not np.isfinite(values).any():
        return "iso", "no numbers"
    if ended := _suffix(header, ("ns", "us", "ms", "s")):
        return ended, "by the column's name"
    largest = float(np.nanmax(np.abs(values)))
    for unit, least in (("ns", 1e17), ("us", 1e14), ("ms", 1e11)):
        if largest > least:
            return unit, f"{largest:.3g} would be no date in seconds"
    if len(values) < MIN_ROWS or not np.array_equal(values, np.rint(values), equal_nan=True):
        return "s", f"numbers up to {largest:.6g}"
    return ASKED, f"whole numbers up to {largest:.6g}, unit unknown: write {', '.join(TIME_UNITS)}"


def _suffix(header: str, units: Iterable[str]) -> str | None:
    """Return the unit at the end of a name such as `range_mm` or `time [ns]`, None without one."""
    last = re.split(r"[^a-z0-9]+", header.lower().strip(")] "))[-1]
    last = {"tick": "ticks", "dtu": "ticks", "sec": "s"}.get(last, last)
    return last if last in units and last != header.lower() else None
