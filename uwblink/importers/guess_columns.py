"""Which columns of a table are which of ours, by their names, and where names do not say it, by what is in them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from itertools import product
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.importers.column_map import EVENT, POSITIONS
from uwblink.importers.guess_words import DEVICE, END, ID, PATTERNS, TWO_ENDS, numbered, plain
from uwblink.importers.table import Table
from uwblink.importers.trials import CLEARLY
from uwblink.twr import STAMPS

OF_MESSAGES: Final = ("tx", "rx", "fpp", "rxp", "skew", "sequence", "message")
_EVENT: Final = re.compile(r"(event|direction|dir|kind|type|action|edge|what|tx_?or_?rx|tx_?rx)")
_STAMP: Final = re.compile(rf"((device|dw|dw1000|raw|chip|uwb)_?)?(stamp|timestamp|time|ticks?|counter|t){END}")
_OF_DEVICE: Final = re.compile(r"device|dw|tick|dtu|raw|chip|counter|^stamp")
_OF_HOST: Final = re.compile(r"host|ros|unix|utc|iso|date|time_s$")
_SENT: Final = ("tx", "t", "sent", "send", "transmit", "transmitted")
_RECEIVED: Final = ("rx", "r", "received", "receive", "recv")


SAME_UNIT: Final = 2.0
"""Ranges and the distances of antennas that differ more, in the median, have different units."""


def stamp_and_event(table: Table, columns: dict[str, str]) -> dict[str, str] | None:
    """Return the columns of a table with a row a stamp; None where no column says of sending or of receiving.

    Of several columns that are times the stamp is the one that is called after a device, or else not after the host.
    """
    if all(name in columns for name in STAMPS[:4]) or ("tx" in columns and "rx" in columns):
        return None
    single = [name for name in table.names if table.names.count(name) == 1]
    event = next((name for name in single if _EVENT.fullmatch(plain(name)) and _is_event(table, name)), None)
    times = [name for name in single if _STAMP.fullmatch(plain(name))]
    if event is None or not times:
        return None
    # The first of those that are equal in that: False is before True.
    stamp = min(times, key=lambda name: (not _OF_DEVICE.search(plain(name)), bool(_OF_HOST.search(plain(name)))))
    rest = {ours: header for ours, header in columns.items() if header not in (stamp, event)}
    if "time_s" not in rest and len(times) > 1:
        rest["time_s"] = next(name for name in times if name != stamp)
    return rest | {"stamp": stamp, EVENT: event}


def _is_event(table: Table, name: str) -> bool:
    """Whether words of a column are of sending and of receiving, about as often."""
    words = np.char.lower(table.read(words=[name])[1][name])
    sent, received = np.isin(words, _SENT), np.isin(words, _RECEIVED)
    return bool(np.mean(sent | received) > CLEARLY and 0.25 < np.mean(sent) < 0.75) if len(sent) else False


def placed(columns: dict[str, str], cells: dict[str, Floats]) -> tuple[dict[str, str], dict[str, Floats], str]:
    """Return columns and cells, without positions that cannot be used, and why these cannot."""
    there = [name for name in POSITIONS if name in columns]
    if not there:
        return columns, cells, ""
    why = ""
    if len(there) < len(POSITIONS):
        lacking = ", ".join(name for name in POSITIONS if name not in columns)
        why = f"positions are used where all six columns are there; missing: {lacking}"
    elif "range_m" in columns:
        ends = np.array([cells[name] for name in POSITIONS])
        apart = np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0))
        used = np.isfinite(apart) & (apart > 0) & np.isfinite(cells["range_m"])
        ratio = float(np.median(cells["range_m"][used] / apart[used])) if used.any() else 1.0
        if not 1 / SAME_UNIT < ratio < SAME_UNIT:
            why = f"positions are left out: ranges are {ratio:.3g} of their distance; distances have one unit"
    if not why:
        return columns, cells, ""
    return (
        {name: header for name, header in columns.items() if name not in POSITIONS},
        {name: column for name, column in cells.items() if name not in POSITIONS},
        why,
    )


def named_columns(names: Iterable[str]) -> dict[str, str]:
    """Return which column each of our names is, raw ones before others, first ones before later ones."""
    listed = sorted(names, key=lambda name: "raw" not in name.lower())
    called = numbered({name: plain(name) for name in listed})
    found = _ends(called)
    for ours, pattern in PATTERNS.items():
        whole = re.compile(f"({pattern}){END}")
        for header in listed:
            if whole.fullmatch(called[header]) and listed.count(header) == 1 and _free(ours, header, found):
                found[ours] = header
                break
    return found


def _ends(called: dict[str, str]) -> dict[str, str]:
    """Return which columns are of the two devices where these are called alike, as `node_i` and `node_j`."""
    for words in product(TWO_ENDS, ("{0}_?{1}", "{0}{2}_{1}", "{0}_?{1}{2}")):
        (one, other), form = words
        ends = []
        for letter in (one, other):
            whole = re.compile(form.format(f"({DEVICE})", letter, ID))
            ends.append([header for header, name in called.items() if whole.fullmatch(name)])
        stems = [{called[header][:2] for header in headers} for headers in ends]
        if all(len(headers) == 1 for headers in ends) and stems[0] == stems[1]:
            return {"from_id": ends[0][0], "to_id": ends[1][0]}
    return {}


def _free(ours: str, header: str, found: dict[str, str]) -> bool:
    """A column is one thing; only the names of messages may repeat those of exchanges, until the layout is known."""
    return header not in [taken for name, taken in found.items() if (name in OF_MESSAGES) == (ours in OF_MESSAGES)]
