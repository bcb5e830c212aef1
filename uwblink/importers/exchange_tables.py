"""Tables of exchanges, of messages or of plain ranges, as CSV, Parquet or JSON lines, one file or several.

What cannot be used is kept as a fault with its row; a table of which that is half or more is refused. `range_m` is what
the device reported, or else the range by the stamps. `gt_range_m`, or the distance between the two antenna positions
(`from_x_m` ... `to_z_m`), is stored beside the exchange as its measured truth; antennas of which the table has
positions are bodies with poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import IDS, POSITIONS, STAMP_UNITS, ColumnMap, load_map
from uwblink.importers.messages import from_messages, from_parts, from_single_stamps, has_ends
from uwblink.importers.stamps import NEVER, beyond, clocks, how_counted, stamps_of, to_ticks
from uwblink.importers.table_rows import Bad, Rows, missing, read_rows, take
from uwblink.importers.trials import SAMPLE, Reading, Sample, Trial, try_others
from uwblink.recording.contents import Contents
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import LARGEST_ID, STAMPS, Exchanges, raw_range

SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".parquet", ".jsonl", ".ndjson", ".jsonl.gz")
A_ROW_NS: Final = 1_000_000
"""Between rows of a table that has no times."""


def read_table(source: Path, map_file: Path | None = None) -> Contents:
    """Return the exchanges of a table, or of all tables in a folder as one; `map_file` says what columns are called.

    `meta["notes"]` says what was found out and what was left out. Raises `ImportTableError`.
    """
    if not source.is_dir():
        return read_tables([source], map_file)
    found = sorted(path for path in source.iterdir() if path.name.lower().endswith(SUFFIXES))
    if not found:
        raise ImportTableError(f"{source}: is a directory without a table ({', '.join(SUFFIXES)})")
    return read_tables(found, map_file)


def read_tables(sources: Sequence[Path], map_file: Path | None = None) -> Contents:
    """Return the exchanges of several files with the same columns as one table; see `read_table`."""
    column_map = load_map(map_file) if map_file else ColumnMap()
    if column_map.topics or column_map.each:
        raise ImportTableError(f"{map_file}: topics and each are of bags; {sources[0]} is a table")
    return convert(read_rows(sources, column_map))


def convert(rows: Rows) -> Contents:
    """Return the exchanges of rows; raises `ImportTableError` where half of them or more cannot be used."""
    total, notes, bad = len(rows), _notes(rows), list[Bad]()
    source = rows
    for name in IDS:
        if name not in rows.ids:
            raise missing(rows, name)
    layout = rows.column_map.layout or _layout(rows)
    protocol = rows.column_map.protocol
    if layout in ("messages", "stamps", "parts"):
        rows = take(rows, np.flatnonzero(_ends(rows, bad)))
        if layout == "stamps":
            rows, lonely = _messages(rows)
            bad += lonely
        if layout != "parts":
            rows, found, incomplete = from_messages(rows)
            protocol = protocol or found
        else:
            rows, incomplete = from_parts(rows)
        bad += incomplete
        total = len(rows) + len(bad)
    if layout == "ranges":
        exchanges, rows = _plain_ranges(rows, bad, total, source)
    else:
        exchanges, rows = _from_stamps(rows, protocol, bad, total, source, notes)
    faults = source.faults(bad)
    if faults:
        notes.append(
            f"{len(faults)} of {total} rows cannot be used and are kept as faults; the first: {faults[0].detail}"
        )
    return Contents(
        exchanges=exchanges,
        tags=_tags(rows, exchanges),
        poses=_poses(rows, exchanges),
        powers=_powers(rows, exchanges),
        faults=faults,
        meta=_meta(source, exchanges, notes),
    )


def _messages(rows: Rows) -> tuple[Rows, list[Bad]]:
    for name in ("stamp", "event", "message"):
        if not rows.has(name):
            raise missing(rows, name)
    return from_single_stamps(rows)


def _layout(rows: Rows) -> str:
    if all(rows.has(name) for name in STAMPS[:4]):
        return "exchanges"
    if rows.has("tx") and rows.has("rx"):
        return "messages"
    if rows.has("stamp") and rows.has("event"):
        return "stamps"
    if rows.has("range_m") and not any(rows.has(name) for name in STAMPS):
        return "ranges"
    raise missing(rows, next(name for name in STAMPS if not rows.has(name)))


def _from_stamps(
    rows: Rows, protocol: str | None, bad: list[Bad], total: int, source: Rows, notes: list[str]
) -> tuple[Exchanges, Rows]:
    """Return exchanges of rows with stamps, and the rows that they are of."""
    stated = rows.column_map.protocol
    chosen = protocol or ("ds" if rows.has("tx3") and rows.has("rx3") else "ss")
    for name in stamps_of(chosen):
        if not rows.has(name):
            raise missing(rows, name)
    scale = rows.column_map.ticks_per_unit
    ticks = {name: rows.cells[name] if scale == 1.0 else rows.cells[name] * scale for name in stamps_of(chosen)}
    bits, counter = how_counted(ticks, rows.column_map.bits, rows.column_map.counter)
    good = _ends(rows, bad) & _time(rows, bad)
    for name, column in ticks.items():
        good &= _stamp(rows, name, column, bits, counter, bad, good)
    _half(source, bad, total)
    del ticks
    rows = rows if good.all() else take(rows, np.flatnonzero(good))
    if counter != "wrapped":
        notes.append(f"stamps are {counter}, and are taken modulo 2^{bits}")
    reading = _reading(rows, Reading(chosen, bits), stated, notes)
    exchanges = _exchanges(rows, reading)
    reported = _optional(rows, "range_m")
    known = np.isfinite(reported)
    exchanges.range_m[:] = reported if known.all() else np.where(known, reported, raw_range(exchanges))
    return exchanges, rows


def _stamp(rows: Rows, name: str, ticks: Floats, bits: int, counter: str, bad: list[Bad], good: Bools) -> Bools:
    """Return which rows have a stamp that can be one, (n,)."""
    largest = (1 << bits) - 1
    finite = np.isfinite(ticks)
    out = finite & beyond(ticks, bits, counter)
    parts = np.zeros(len(ticks), dtype=bool)
    if rows.column_map.ticks_per_unit == STAMP_UNITS["ticks"]:
        parts = finite & (ticks != np.rint(ticks))
    _reject(rows, bad, name, good & ~finite, "a finite number")
    unit = "a whole number" if rows.column_map.ticks_per_unit == STAMP_UNITS["ticks"] else "a stamp in ticks"
    _reject(
        rows,
        bad,
        name,
        good & (out | parts),
        f"{unit} from {0 if counter == 'wrapped' else -largest // 2} to {largest}",
    )
    return np.asarray(finite & ~out & ~parts)


def _reading(rows: Rows, reading: Reading, stated: str | None, notes: list[str]) -> Reading:
    """Return how to read the stamps: as they were meant, or as they clearly make ranges where they do not so."""
    random = np.random.default_rng(0)
    chosen = np.sort(random.choice(len(rows), min(SAMPLE, len(rows)), replace=False))
    pair = rows.ids["from_id"][chosen] * (LARGEST_ID + 1) + rows.ids["to_id"][chosen]
    cells = {name: rows.cells[name][chosen] for name in STAMPS if rows.has(name)}
    truth = rows.cells["gt_range_m"][chosen] if "gt_range_m" in rows.cells else np.full(len(chosen), np.nan)
    first, other = try_others(Sample(cells, pair, truth, rows.column_map.ticks_per_unit), reading)
    if other is None:
        if first.plausible < 0.5 and len(chosen) >= 20:
            notes.append(
                f"the ranges are not plausible ({_span(first)}), and no other protocol, width or order of the columns "
                "makes better ones; check the map"
            )
        return reading
    difference = other.reading.difference(reading)
    if other.reading.swapped or (stated and other.reading.protocol != reading.protocol) or rows.column_map.bits:
        raise ImportTableError(
            f'{rows.paths[0]}: by protocol "{reading.protocol}" its ranges are {_span(first)}; '
            f"with {difference} they are {_span(other)}: say so in the map"
        )
    notes.append(f'read with {difference}: by protocol "{reading.protocol}" the ranges would be {_span(first)}')
    return other.reading


def _span(trial: Trial) -> str:
    return f"{trial.low_m:.4g} to {trial.high_m:.4g} m"


def _exchanges(rows: Rows, reading: Reading) -> Exchanges:
    names = stamps_of(reading.protocol)
    ticks = to_ticks(
        {name: rows.cells[name] for name in names},
        clocks(reading.protocol),
        rows.column_map.ticks_per_unit,
        reading.bits,
    )
    none = np.zeros(len(rows), dtype=np.int64)
    return _of_rows(rows, reading.protocol, reading.bits, {name: ticks.get(name, none) for name in STAMPS})


def _of_rows(rows: Rows, protocol: str, bits: int, stamps: dict[str, Ints]) -> Exchanges:
    count = len(rows)
    when = rows.time_ns if rows.time_ns is not None else np.arange(count, dtype=np.int64) * A_ROW_NS
    return Exchanges(
        time_ns=when,
        initiator=rows.ids["from_id"],
        target=rows.ids["to_id"],
        reporter=rows.ids["from_id"],
        protocol=np.full(count, protocol),
        range_m=np.zeros(count),
        fpp1_dbm=_optional(rows, "fpp1"),
        fpp2_dbm=_optional(rows, "fpp2"),
        skew1_ppm=_optional(rows, "skew1"),
        skew2_ppm=_optional(rows, "skew2"),
        truth_m=_truth(rows),
        bits=bits,
        **stamps,
    )


def _plain_ranges(rows: Rows, bad: list[Bad], total: int, source: Rows) -> tuple[Exchanges, Rows]:
    """Return exchanges without stamps: single-sided ones, whose range is the one that was reported."""
    if not rows.has("range_m"):
        raise missing(rows, "range_m")
    good = _ends(rows, bad) & _time(rows, bad)
    finite = np.isfinite(rows.cells["range_m"])
    _reject(rows, bad, "range_m", good & ~finite, "a finite number")
    _half(source, bad, total)
    rows = take(rows, np.flatnonzero(good & finite))
    none = np.zeros(len(rows), dtype=np.int64)
    exchanges = _of_rows(rows, "ss", 32, dict.fromkeys(STAMPS, none))
    return replace(exchanges, range_m=rows.cells["range_m"].copy()), rows


def _ends(rows: Rows, bad: list[Bad]) -> Bools:
    for name in IDS:
        _reject(rows, bad, name, rows.ids[name] == NEVER, f"a whole number from 0 to {LARGEST_ID}")
    same = (rows.ids["from_id"] == rows.ids["to_id"]) & (rows.ids["to_id"] != NEVER)
    _reject(rows, bad, "to_id", same, "another tag than from_id")
    return has_ends(rows)


def _time(rows: Rows, bad: list[Bad]) -> Bools:
    if rows.time_ns is None:
        return np.ones(len(rows), dtype=bool)
    _reject(rows, bad, "time_s", (rows.time_ns == NEVER) & has_ends(rows), "a time")
    return np.asarray(rows.time_ns != NEVER)


def _reject(rows: Rows, bad: list[Bad], name: str, wrong: Bools, expected: str) -> None:
    bad += [Bad(int(rows.origin[row]), name, expected) for row in np.flatnonzero(wrong)]


def _half(source: Rows, bad: list[Bad], total: int) -> None:
    """Raise for the first bad row where they are not few."""
    if bad and 2 * len({one.row for one in bad}) >= total:
        first = min(bad, key=lambda one: one.row)
        (fault,) = replace(source, too_long={}).faults([first])
        raise ImportTableError(f"{source.paths[source.file[first.row]]}: {fault.detail}")


def _optional(rows: Rows, name: str) -> Floats:
    column = rows.cells.get(name)
    if column is None:
        return np.full(len(rows), np.nan)
    finite = np.isfinite(column)
    return column if finite.all() else np.where(finite, column, np.nan)


def _truth(rows: Rows) -> Floats:
    if "gt_range_m" in rows.cells:
        return _optional(rows, "gt_range_m")
    if not all(name in rows.cells for name in POSITIONS):
        return np.full(len(rows), np.nan)
    ends = np.array([_optional(rows, name) for name in POSITIONS])
    return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))


def _powers(rows: Rows, exchanges: Exchanges) -> dict[str, NDArray[Any]]:
    if not (rows.has("rxp1") or rows.has("rxp2")):
        return {}
    e = exchanges
    levels = {f"{name}_dbm": _optional(rows, name) for name in ("rxp1", "rxp2")}
    return {"time_ns": e.time_ns, "initiator": e.initiator, "target": e.target, **levels}


def _tags(rows: Rows, exchanges: Exchanges) -> list[Tag]:
    ids = sorted({*np.unique(exchanges.initiator).tolist(), *np.unique(exchanges.target).tolist()})
    return [Tag(i, rows.names.get(i, f"tag{i}"), (0.0, 0.0, 0.0)) for i in ids]


def _poses(rows: Rows, exchanges: Exchanges) -> Poses:
    """Return where the table says that antennas were: a pose a row, one alone for what never moves."""
    none = Poses(np.empty(0, np.int64), np.empty(0, np.str_), np.empty((0, 3)), np.empty((0, 4)))
    if not all(name in rows.cells for name in POSITIONS):
        return none
    parts = []
    for tag in _tags(rows, exchanges):
        time, place = [], []
        for ids, end in ((exchanges.initiator, "from"), (exchanges.target, "to")):
            mine = ids == tag.tag
            at = np.column_stack([rows.cells[f"{end}_{axis}_m"][mine] for axis in "xyz"])
            known = np.isfinite(at).all(axis=1)
            time.append(exchanges.time_ns[mine][known])
            place.append(at[known])
        when, first = np.unique(np.concatenate(time), return_index=True)
        where = np.concatenate(place)[first]
        if len(where) and not np.ptp(where, axis=0).any():
            when, where = when[:1], where[:1]
        parts.append(Poses(when, np.full(len(when), tag.body), where, np.tile([0.0, 0.0, 0.0, 1.0], (len(when), 1))))
    time_ns = np.concatenate([part.time_ns for part in parts])
    order = np.argsort(time_ns, kind="stable")
    body = np.concatenate([part.body for part in parts])
    position = np.concatenate([part.position_m for part in parts])
    return Poses(time_ns[order], body[order], position[order], np.tile([0.0, 0.0, 0.0, 1.0], (len(order), 1)))


def _notes(rows: Rows) -> list[str]:
    notes = []
    if rows.names:
        some = ", ".join(f"{name[:20]} = {number}" for number, name in list(rows.names.items())[:5])
        notes.append(f"{len(rows.names)} ids are words or too large, and get numbers: {some}")
    if rows.time_ns is None:
        notes.append("there is no time; rows are put a millisecond apart, in their order")
    return notes


def _meta(rows: Rows, exchanges: Exchanges, notes: list[str]) -> dict[str, Any]:
    delays = rows.column_map.antenna_delays
    meta: dict[str, Any] = {
        "source": "import csv",
        "imported_from": ", ".join(path.name for path in rows.paths),
        "timestamp_bits": exchanges.bits,
        "notes": notes,
    }
    if rows.names:
        meta["tag_names"] = {str(number): name for number, name in sorted(rows.names.items())}
    if delays:
        meta["configured_antenna_delay_ticks"] = delays[None]
        own = {str(tag): registers for tag, registers in delays.items() if tag is not None}
        if own:
            meta["configured_antenna_delay_ticks_by_tag"] = own
    return meta
