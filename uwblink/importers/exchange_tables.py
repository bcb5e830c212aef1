"""Tables of exchanges, of messages or of plain ranges, as CSV, Parquet or JSON lines, one file or several.

What cannot be used is kept as a fault with its row; a table of which that is half or more is refused. `range_m` is what
the device reported, or else the range by the stamps. `gt_range_m`, or the distance between the two antenna positions
(`from_x_m` ... `to_z_m`), is stored beside the exchange as its measured truth; antennas of which the table has
positions are bodies with poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import DISTANCES, IDS, LEVELS, ColumnMap, load_map
from uwblink.importers.exchange_rows import optional
from uwblink.importers.long_tables import exchanges_of_long
from uwblink.importers.repeated import likely_repeated
from uwblink.importers.staged_tables import StagedTables, Watch
from uwblink.importers.stamps import stamps_of
from uwblink.importers.table_import import TableImport
from uwblink.importers.table_rows import Rows, RowSource, has
from uwblink.importers.trials import SAMPLE, Reading, Sample, Trial, try_others
from uwblink.importers.units import check_units
from uwblink.importers.unusable import Unusable
from uwblink.importers.usable import Usable, usable_exchanges, usable_ranges
from uwblink.recording.contents import Contents
from uwblink.ticks import ANTENNA_DELAY_TICKS, METRES_PER_TICK
from uwblink.twr import LARGEST_ID, STAMPS

MOST_NAMES: Final = 12
"""Ids that are words and are printed with their numbers; a recording has all, as its tags' bodies."""

SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".parquet", ".jsonl", ".ndjson", ".jsonl.gz")


def read_table(source: Path, map_file: Path | None = None) -> Contents:
    """Return the exchanges of a table, or of all tables in a folder as one; `map_file` says what columns are called.

    `meta["notes"]` says what was found out and what was left out. Raises `ImportTableError`.
    """
    return read_tables([source], map_file)


def read_tables(sources: Sequence[Path], map_file: Path | None = None) -> Contents:
    """Return the exchanges of several files with the same columns as one table; see `read_table`."""
    with open_tables(sources, map_file) as found:
        return found.contents()


@contextmanager
def open_tables(
    sources: Sequence[Path], map_file: Path | None = None, watch: Watch | None = None
) -> Iterator[TableImport]:
    """Yield what `read_tables` returns, as something that can be written without being in memory at once."""
    paths = _tables(sources)
    column_map = load_map(map_file) if map_file else ColumnMap()
    if column_map.topics or column_map.each:
        raise ImportTableError(f"{map_file}: topics and each are of bags; {paths[0]} is a table")
    with StagedTables(paths, column_map, watch) as tables:
        yield plan(tables, watch)


def _tables(sources: Sequence[Path]) -> list[Path]:
    if len(sources) != 1 or not sources[0].is_dir():
        return list(sources)
    found = sorted(path for path in sources[0].iterdir() if path.name.lower().endswith(SUFFIXES))
    if not found:
        raise ImportTableError(f"{sources[0]}: is a directory without a table ({', '.join(SUFFIXES)})")
    return found


def plan(tables: StagedTables, watch: Watch | None = None) -> TableImport:
    """Return what is to be written of tables; raises `ImportTableError` where half of the rows or more are no use."""
    notes, unusable = _notes(tables), Unusable()
    for name in IDS:
        if not tables.has(name):
            raise tables.missing(name)
    layout = tables.column_map.layout or _layout(tables)
    source: RowSource = tables
    total, protocol = len(tables), tables.column_map.protocol
    if layout in ("messages", "stamps", "parts"):
        source, found = exchanges_of_long(tables, layout, unusable, watch)
        total, protocol = len(source) + len(unusable), protocol or found
    if watch:
        watch("checking", 0.0)
    if layout == "ranges":
        usable, reading = _plain_ranges(tables, source, unusable, total), None
        check_units(tables, _sample(source, usable), None)
        first, _ = next(usable.of_blocks(source.blocks(["range_m"])))
        notes += filter(None, [likely_repeated(first)])
    else:
        usable, reading = _from_stamps(tables, source, protocol, unusable, total, notes)
    return TableImport(
        tables=tables, source=source, usable=usable, unusable=unusable, reading=reading, notes=notes, total=total,
        watch=watch,
    )  # fmt: skip


def _layout(tables: StagedTables) -> str:
    if all(tables.has(name) for name in STAMPS[:4]):
        return "exchanges"
    if tables.has("tx") and tables.has("rx"):
        return "messages"
    if tables.has("stamp") and tables.has("event"):
        return "stamps"
    if tables.has("range_m") and not any(tables.has(name) for name in STAMPS):
        return "ranges"
    raise tables.missing(next(name for name in STAMPS if not tables.has(name)))


def _plain_ranges(tables: StagedTables, source: RowSource, unusable: Unusable, total: int) -> Usable:
    if not source.has("range_m"):
        raise tables.missing("range_m")
    usable = usable_ranges(source, unusable)
    _half(tables, unusable, total)
    return usable


def _from_stamps(
    tables: StagedTables, source: RowSource, protocol: str | None, unusable: Unusable, total: int, notes: list[str]
) -> tuple[Usable, Reading]:
    """Return the rows that can be used, and how their stamps are to be read."""
    chosen = protocol or ("ds" if source.has("tx3") and source.has("rx3") else "ss")
    for name in stamps_of(chosen):
        if not source.has(name):
            raise tables.missing(name)
    usable, bits, counter = usable_exchanges(source, unusable, stamps_of(chosen), tables.stage)
    _half(tables, unusable, total)
    if usable.repeated:
        notes.append(
            f"{usable.repeated} of {total} rows repeat an exchange, with the same devices and stamps, and are left out"
        )
    if counter != "wrapped":
        notes.append(f"stamps are {counter}, and are taken modulo 2^{bits}")
    sample = _sample(source, usable)
    reading = _reading(tables, sample, Reading(chosen, bits), notes)
    check_units(tables, sample, reading)
    return usable, reading


def _half(tables: StagedTables, unusable: Unusable, total: int) -> None:
    """Raise for the first row that cannot be used where they are not few."""
    if unusable and 2 * unusable.distinct() >= total:
        reason, origin = unusable.first()
        raise ImportTableError(f"{tables.path_of(origin)}: {tables.fault(reason, origin).detail}")


def _sample(source: RowSource, usable: Usable) -> Rows:
    """Return some of the rows that can be used, drawn by chance."""
    random = np.random.default_rng(0)
    chosen = np.sort(random.choice(usable.count, min(SAMPLE, usable.count), replace=False))
    return source.at(usable.places(chosen), (*STAMPS, *LEVELS, *DISTANCES))


def _reading(tables: StagedTables, rows: Rows, reading: Reading, notes: list[str]) -> Reading:
    """Return how to read the stamps: as they were meant, or as they clearly make ranges where they do not so."""
    column_map = tables.column_map
    pair = rows.ids["from_id"] * (LARGEST_ID + 1) + rows.ids["to_id"]
    cells = {name: rows.cells[name] for name in STAMPS if has(rows, name)}
    sample = Sample(
        cells, pair, optional(rows, "gt_range_m"), optional(rows, "skew2"), _longer_m(rows), column_map.ticks_per_unit
    )
    first, other = try_others(sample, reading)
    if other is None:
        if first.plausible < 0.5 and len(rows) >= 20:
            notes.append(
                f"the ranges are not plausible ({_span(first)}), and no other protocol, width or order of the columns "
                "makes better ones; check the map"
            )
        return reading
    difference = other.reading.difference(reading)
    contradicted = (
        other.reading.swapped
        or (column_map.protocol and other.reading.protocol != reading.protocol)
        or (column_map.bits and other.reading.bits != reading.bits)
        or (column_map.antenna_delays and other.reading.undelayed)
    )
    if contradicted:
        raise ImportTableError(
            f'{tables.paths[0]}: by protocol "{reading.protocol}" its ranges are {_span(first)}; '
            f"with {difference} they are {_span(other)}: say so in the map"
        )
    notes.append(f'read with {difference}: by protocol "{reading.protocol}" the ranges would be {_span(first)}')
    return other.reading


def _longer_m(rows: Rows) -> Floats:
    """Return by how much ranges (n,) are longer because of antenna delays that were not programmed, by the map."""
    delays = rows.column_map.antenna_delays
    if not delays:
        return np.broadcast_to(0.0, len(rows))
    lacking = np.zeros(len(rows))
    for name in IDS:
        ids, back = np.unique(rows.ids[name], return_inverse=True)
        programmed = [sum(delays.get(int(tag), delays[None]).values()) for tag in ids]
        lacking += (2 * ANTENNA_DELAY_TICKS - np.array(programmed, dtype=np.float64))[back]
    return lacking / 2 * METRES_PER_TICK


def _span(trial: Trial) -> str:
    return f"{trial.low_m:.4g} to {trial.high_m:.4g} m"


def _notes(tables: StagedTables) -> list[str]:
    notes = []
    if tables.names:
        some = ", ".join(f"{name[:20]} = {number}" for number, name in list(tables.names.items())[:MOST_NAMES])
        more = f" and {len(tables.names) - MOST_NAMES} more" if len(tables.names) > MOST_NAMES else ""
        notes.append(f"{len(tables.names)} ids are words or too large, and get numbers: {some}{more}")
    if not tables.has("time_s"):
        notes.append("there is no time; rows are put a millisecond apart, in their order")
    return notes
