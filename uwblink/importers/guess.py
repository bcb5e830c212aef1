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
from dataclasses import dataclass
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
    ColumnMap,
)
from uwblink.importers.plausibility import (
    ACCEPTED_SHARE,
    FITTING_SHARE,
    MIN_ROWS,
    SAMPLE_ROWS,
    Reading,
    counter_format,
    reason_against_dbm,
    reason_against_metres,
    stamps_of,
    truth_m,
    try_reading,
)
from uwblink.importers.tables import Columns, SourceTable, open_table
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
    return names | {h: f"{m['level']}_{numbers[m['whose']]}{m['end']}" for h, m in matches.items() if m}


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


def with_stamp_and_event(table: SourceTable, columns: dict[str, str]) -> dict[str, str]:
    """Return the columns of a table with a stamp and its event in each row; the same columns for another table.

    If several columns are times, the stamp is the one whose name mentions a device, or else does not mention the host.
    """
    if all(name in columns for name in STAMPS[:4]) or ("tx" in columns and "rx" in columns):
        return columns
    single = {name: _plain(name) for name in table.names if table.names.count(name) == 1}
    kinds = r"(event|direction|dir|kind|type|action|edge|what|tx_?or_?rx|tx_?rx)"
    clock = rf"((device|dw|dw1000|raw|chip|uwb)_?)?(stamp|timestamp|time|ticks?|counter|t){_WORDS['end']}"
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
    """Return whether a column has words for transmission and reception, about equally often."""
    word = f"lower(trim({table.text(name)}))"
    sent = f"{word} IN ('tx', 't', 'sent', 'send', 'transmit', 'transmitted')"
    received = f"{word} IN ('rx', 'r', 'received', 'receive', 'recv')"
    shares = table.read({"sent": f"avg(({sent})::INT)", "received": f"avg(({received})::INT)"})
    sending, receiving = (float(np.ma.filled(share, 0.0)[0]) for share in shares.values())
    return sending + receiving > 0.9 and 0.25 < sending < 0.75


_OF_EXCHANGES: Final = (*STAMPS, "fpp1", "fpp2", "rxp1", "rxp2", "skew1", "skew2")

_LAYOUTS: Final = {
    "exchanges": (STAMPS[:4], OF_MESSAGES, "a row has the stamps of a whole exchange"),
    "messages": (("tx", "rx"), _OF_EXCHANGES, "a row has one stamp of a sender and one of a receiver"),
    "stamps": (("message",), _OF_EXCHANGES, "a row has one stamp, and says whether it is of sending or of receiving"),
    "ranges": (("range_m",), (*OF_MESSAGES, *STAMPS), "there are ranges and no stamps"),
    "nothing": ((), OF_MESSAGES, "neither stamps nor ranges were recognised: rename columns below"),
}
"""The layouts that are recognised: the columns that each needs, those that it does not have, and the reason."""

Entries = dict[str, tuple[str | int, str]]
"""Values of a map by key, each with its reason."""


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
    with open_table(path) as table:
        columns = with_stamp_and_event(table, named_columns(table.names))
        numbers = table.numbers({header for name, header in columns.items() if name != "event"}, limit=100_000)
    cells = {name: numbers[header] for name, header in columns.items() if name != "event"}
    if not len(next(iter(cells.values()), np.empty(0))):
        raise ImportTableError(f"{path}: no column whose name is known, or no rows; there are {', '.join(table.names)}")
    words = {name for name, column in cells.items() if not np.isfinite(column).any()}
    fitting = (one for one in ("exchanges", "messages", "ranges") if all(name in cells for name in _LAYOUTS[one][0]))
    layout = "stamps" if "event" in columns else next(fitting, "nothing")
    needed, foreign, why = _LAYOUTS[layout]
    if layout == "messages" and "message" in words and columns["message"] != "message":
        del columns["message"], cells["message"]  # without a column of that name messages are told by their order
    top: Entries = {} if layout == "nothing" else {"layout": (layout, why)}
    units, undelayed = _units(columns, cells), False
    if layout in ("exchanges", "messages", "stamps"):
        counter, unit, undelayed = (_exchange_stamps if layout == "exchanges" else _message_stamps)(columns, cells)
        top, units = top | counter, {"stamps": unit, **units}
    constants: Entries = {
        name: (
            ASKED,
            f"no column was recognised as {IDS[name]}: write a number or a word for all rows, or the column above",
        )
        for name in IDS
        if name not in columns
    }
    lacking = [name for name in needed if name not in cells or name in words]
    lacking += ["message"] if layout == "messages" and "message" in words & cells.keys() else []
    unplaced = [name for name in POSITIONS if name not in columns]
    left = [json.dumps(name) for name in table.names if name not in columns.values()]
    mixed = sorted(_distance_units(columns))
    remarks = {
        why: layout == "nothing",
        "without antenna delays that were programmed into the devices: give them in [antenna_delays]": not undelayed,
        f"positions are used where all six columns are there; missing: {', '.join(unplaced)}": 0 < len(unplaced) < 6,
        f"not used: {', '.join(left)[:300]}": left,
        f"a column of numbers is still needed: {', '.join(lacking)}": lacking,
        f"distances have one unit for all, here they have {', '.join(mixed)}: convert some": len(mixed) > 1,
    }
    named: Entries = {name: (header, "") for name, header in columns.items() if name not in foreign}
    none: Entries = {"tx": (0, "by the true distances none were programmed into the devices"), "rx": (0, "")}
    sections = {"columns": named, "units": units, "constants": constants, "antenna_delays": none if undelayed else {}}
    # Names of files can have line breaks, which would end the comment.
    lines = [f"# {json.dumps(path.name)}, as it would be read; every line can be changed", *_lines(top)]
    for title, entries in sections.items():
        lines += ["", f"[{title}]", *_lines(entries)] if entries else []
    lines += ["", *(f"# {text}" for text, is_due in remarks.items() if is_due)]
    asked = [key for entries in (constants, top, units) for key, (value, _) in entries.items() if value == ASKED]
    return Guess("\n".join(lines) + "\n", layout != "nothing" and not lacking and len(mixed) < 2, tuple(asked))


def _lines(entries: Entries) -> list[str]:
    return [f"{key} = {json.dumps(value)}" + (f"  # {why}" if why else "") for key, (value, why) in entries.items()]


StampEntries = tuple[Entries, tuple[str, str], bool]
"""Protocol and counter, the unit of stamps with its reason, and whether no antenna delays were programmed."""

_ANY_UNIT: Final = f"unit unknown: write {', '.join(STAMP_UNITS)}"


def _message_stamps(columns: dict[str, str], cells: dict[str, Floats]) -> StampEntries:
    """Return how to read the stamps of a table of messages or of single stamps."""
    stamps: dict[str, Floats] = {name: cells[name] for name in ("tx", "rx", "stamp") if name in cells}
    named = next(iter(_ended(columns, stamps, STAMP_UNITS)), None)
    bits, kind = counter_format(column * STAMP_UNITS[named or "ticks"] for column in stamps.values())
    largest = max(float(np.nanmax(column, initial=0.0)) for column in stamps.values())
    # Of 22 stamps in ticks one at least is in the last tenth of the counter in nine tables of ten.
    full = _are_whole(stamps) and 0.9 * 2.0**bits < largest < 2.0**bits
    counter: Entries = {"bits": (bits, ""), "counter": (kind, "")}
    if named:
        return counter, (named, "by the columns' names"), False
    return counter, ("ticks", f"whole numbers up to 2^{bits}") if full else (ASKED, _ANY_UNIT), False


def _exchange_stamps(columns: dict[str, str], cells: dict[str, Floats]) -> StampEntries:
    """Return how to read the stamps of a table of exchanges: by which protocol and unit their ranges are plausible."""
    stamps: dict[str, Floats] = {name: cells[name] for name in STAMPS if name in cells}
    whole, named = _are_whole(stamps), _ended(columns, stamps, STAMP_UNITS)
    chosen = np.flatnonzero(np.all([np.isfinite(column) for column in stamps.values()], axis=0))[:SAMPLE_ROWS]
    if not len(chosen):
        raise ImportTableError("its stamps are no numbers in any row")
    rows: Columns = {name: column[chosen] for name, column in stamps.items()}
    rows |= dict.fromkeys(("origin", *IDS), np.zeros(len(chosen), np.int64))
    if "gt_range_m" in cells:
        rows["gt_range_m"] = cells["gt_range_m"][chosen] * DISTANCE_UNITS[min(_distance_units(columns), default="m")]
    protocols = [row.name for row in PROTOCOLS.known() if set(stamps_of(row.name)) == set(stamps)]
    protocols = [name for name in protocols if name not in ("ss-cfo", "ds-sym")] or ["ss"]
    undelayed = (False, True) if np.isfinite(truth_m(rows)).any() else (False,)
    trials = []
    for unit in sorted(named) or (["ticks", "ns", "us", "s", "ps"] if whole else ["ns", "us", "s", "ps"]):
        scale = STAMP_UNITS[unit]
        bits, kind = counter_format(rows[name] * scale for name in stamps)
        for without, name in product(undelayed, protocols):
            reading = Reading(name, bits, undelayed=without)
            trials.append((unit, kind, try_reading(rows, ColumnMap(ticks_per_unit=scale), reading)))
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


def _units(columns: dict[str, str], cells: dict[str, Floats]) -> Entries:
    """Return the units of times, distances and powers, each with its reason, as far as they are not the default."""
    found: Entries = {}
    if "time_s" in columns:
        found["time"] = _time_unit(columns["time_s"], cells["time_s"])
    units = _distance_units(columns)
    if len(units) == 1:
        found["distance"] = min(units), "by the columns' names"
    elif not units and "range_m" in cells and (why := reason_against_metres(cells["range_m"])):
        found["distance"] = ASKED, f"{why}: write {', '.join(DISTANCE_UNITS)}"
    if why := next(filter(None, (reason_against_dbm(cells[name]) for name in POWERS if name in cells)), ""):
        found["power"] = ASKED, f"{why}: write -dBm if they lack their sign"
    return found


def _distance_units(columns: dict[str, str]) -> set[str]:
    """Return the units in the names of columns of ranges, true distances and positions."""
    return _ended(columns, DISTANCES, DISTANCE_UNITS)


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


def _ended(columns: dict[str, str], names: Iterable[str], units: Iterable[str]) -> set[str]:
    """Return the units at the ends of the headers of some columns."""
    return {unit for name in names if name in columns and (unit := _suffix(columns[name], units))}


def _suffix(header: str, units: Iterable[str]) -> str | None:
    """Return the unit at the end of a name such as `range_mm` or `time [ns]`, None without one."""
    last = re.split(r"[^a-z0-9]+", header.lower().strip(")] "))[-1]
    last = {"tick": "ticks", "dtu": "ticks", "sec": "s"}.get(last, last)
    return last if last in units and last != header.lower() else None
