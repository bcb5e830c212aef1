"""Tables of exchanges, of messages or of plain ranges, as CSV, Parquet or JSON lines, one file or several.

The steps: stage the table (`staging`), combine the rows of each exchange (`exchange_rows`), record unusable rows as
faults (`exchange_rows`), write the exchanges in blocks. A table is refused if half of its rows or more are unusable.
`range_m` is the range that the device reported, or else the range by the stamps. `gt_range_m`, or the distance between
the two antenna positions (`from_x_m` ... `to_z_m`), is stored as the true distance of the exchange; antennas with
positions become bodies with poses.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

import numpy as np

from uwblink.arrays import Floats
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import IDS, POSITIONS, ColumnMap, load_map
from uwblink.importers.exchange_rows import (
    ENDS,
    Faults,
    assemble_exchanges,
    usable_exchanges,
    usable_ranges,
)
from uwblink.importers.plausibility import (
    ACCEPTED_SHARE,
    MIN_ROWS,
    SAMPLE_ROWS,
    Reading,
    Sample,
    Trial,
    check_units,
    clocks,
    find_other_reading,
    optional,
    stamps_of,
    to_ticks,
    truth_m,
)
from uwblink.importers.staging import ROWS_AT_ONCE, Staging, Watch, staged, unwatched
from uwblink.importers.tables import Columns
from uwblink.recording.antenna_delays import AntennaDelay, delay_of, meta_of_delays
from uwblink.recording.contents import Contents, load
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import ANTENNA_DELAY_TICKS, METRES_PER_TICK
from uwblink.twr import LARGEST_ID, STAMPS, Exchanges, raw_range

TABLE_SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".parquet", ".jsonl", ".ndjson", ".jsonl.gz")
ROW_PERIOD_NS: Final = 1_000_000
"""Time between the rows of a table without times."""


@contextmanager
def open_tables(
    sources: Sequence[Path], map_file: Path | None = None, watch: Watch = unwatched
) -> Iterator[TableImport]:
    """Open one table, all tables of a folder as one, or several files as one; raises `ImportTableError`.

    `map_file` has names and units of the columns.
    """
    paths = list(sources)
    if len(paths) == 1 and paths[0].is_dir():
        paths = sorted(path for path in paths[0].iterdir() if path.name.lower().endswith(TABLE_SUFFIXES))
        if not paths:
            raise ImportTableError(f"{sources[0]}: is a directory without a table ({', '.join(TABLE_SUFFIXES)})")
    column_map = load_map(map_file) if map_file else ColumnMap()
    if column_map.topics or column_map.each:
        raise ImportTableError(f"{map_file}: topics and each are of bags; {paths[0]} is a table")
    with staged(paths, column_map, watch) as staging:
        yield TableImport(staging, "import csv", ", ".join(path.name for path in paths), watch)


def _notes(staging: Staging) -> list[str]:
    notes, names = [], staging.names
    if names:
        # The first dozen; a recording has all, as its tags' bodies.
        some = ", ".join(f"{name[:20]} = {number}" for number, name in list(names.items())[:12])
        more = f" and {len(names) - 12} more" if len(names) > 12 else ""
        notes.append(f"{len(names)} ids are words or too large, and get numbers: {some}{more}")
    if not staging.rows.has("time_s"):
        notes.append("there are no times; rows are taken as a millisecond apart, in their order")
    return notes


def _layout(staging: Staging) -> str:
    """Return the layout that the columns suggest."""
    has = staging.rows.has
    for layout, names in (("exchanges", STAMPS[:4]), ("messages", ("tx", "rx")), ("stamps", ("stamp", "event"))):
        if all(map(has, names)):
            return layout
    if has("range_m") and not any(map(has, STAMPS)):
        return "ranges"
    raise staging.missing(next(name for name in STAMPS if not has(name)))


def _reading(column_map: ColumnMap, path: Path, rows: Columns, reading: Reading, notes: list[str]) -> Reading:
    """Return how to read the stamps: as the map says, or otherwise if only that makes plausible ranges."""
    pair = rows["from_id"] * (LARGEST_ID + 1) + rows["to_id"]
    # In the unit of the table; stamps that only other protocols have may be missing.
    cells: dict[str, Floats] = {name: rows[name] for name in STAMPS if name in rows}
    longer_m = _longer_m(column_map, rows)
    truth_m, skew2 = optional(rows, "gt_range_m"), optional(rows, "skew2")
    first, other = find_other_reading(Sample(cells, pair, truth_m, skew2, longer_m, column_map.ticks_per_unit), reading)
    if other is None:
        if first.plausible < ACCEPTED_SHARE and len(pair) >= MIN_ROWS:
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
            f'{path}: by protocol "{reading.protocol}" its ranges are {_span(first)}; '
            f"with {difference} they are {_span(other)}: state that in the map"
        )
    notes.append(f'read with {difference}: by protocol "{reading.protocol}" the ranges would be {_span(first)}')
    return other.reading


def _longer_m(column_map: ColumnMap, rows: Columns) -> Floats:
    """Return the lengths (n,) that missing antenna delays add to ranges, by the map."""
    lacking, delays = np.zeros(len(rows["origin"])), column_map.antenna_delays
    for name in IDS if delays else ():
        ids, back = np.unique(rows[name], return_inverse=True)
        programmed = [delay_of(delays, int(tag)) or AntennaDelay() for tag in ids]
        lacking += (2 * ANTENNA_DELAY_TICKS - np.array([one.tx + one.rx for one in programmed], np.float64))[back]
    return lacking / 2 * METRES_PER_TICK


def _span(trial: Trial) -> str:
    return f"{trial.low_m:.4g} to {trial.high_m:.4g} m"


def exchanges_of(column_map: ColumnMap, rows: Columns, reading: Reading | None, before: int = 0) -> Exchanges:
    """Return rows as exchanges with the reported ranges, or else those by the stamps; `before` counts earlier rows.

    Without a reading the rows are ranges without stamps: single-sided exchanges whose stamps are 0.
    """
    count = len(rows["origin"])
    stamps: dict[str, Any] = dict.fromkeys(STAMPS, np.zeros(count, dtype=np.int64))
    protocol, bits = (reading.protocol, reading.bits) if reading else ("ss", 32)
    if reading:
        stamps |= to_ticks(rows, clocks(protocol), column_map.ticks_per_unit, bits)
    exchanges = Exchanges(
        time_ns=rows.get("time_ns", np.arange(before, before + count) * ROW_PERIOD_NS),
        initiator=rows["from_id"], target=rows["to_id"], reporter=rows["from_id"], protocol=np.full(count, protocol),
        range_m=optional(rows, "range_m"), fpp1_dbm=optional(rows, "fpp1"), fpp2_dbm=optional(rows, "fpp2"),
        skew1_ppm=optional(rows, "skew1"), skew2_ppm=optional(rows, "skew2"), truth_m=truth_m(rows), bits=bits,
        **stamps,
    )  # fmt: skip
    known = np.isfinite(exchanges.range_m)
    return (
        exchanges
        if known.all()
        else replace(exchanges, range_m=np.where(known, exchanges.range_m, raw_range(exchanges)))
    )


class TableImport:
    """Usable rows of staged tables, and how to read their stamps.

    `reading` is None for ranges without stamps; `notes` are for the user; `total` counts usable and faulty rows.
    """

    def __init__(self, staging: Staging, source: str, imported_from: str, watch: Watch) -> None:
        """Check staged tables; raises `ImportTableError` if half of the rows or more are unusable.

        `source` and `imported_from` go into the recording's `meta`.
        """
        column_map, rows, faults = staging.column_map, staging.rows, Faults(staging)
        self.staging, self.faults, self.watch = staging, faults, watch
        self._source = {"source": source, "imported_from": imported_from}
        staging.require(rows, IDS)
        self.notes = _notes(staging)
        layout, protocol = column_map.layout or _layout(staging), column_map.protocol
        if layout in ("messages", "stamps", "parts"):
            rows, good, found = assemble_exchanges(staging, layout, faults, watch)
            protocol = protocol or found
        else:
            good = faults.reject(rows, ENDS)
        self.total = rows.count(good) + len(faults)
        watch("checking", 0.0)
        self.reading: Reading | None = None
        if layout == "ranges":
            staging.require(rows, ["range_m"])
            self.usable = usable_ranges(rows, faults, good)
            faults.check(self.total)
            check_units(column_map, staging.paths[0], self.usable.sample(SAMPLE_ROWS), None)
            self.notes += filter(None, [note_on_repeats(next(self.usable.blocks()))])
            return
        protocol = protocol or ("ds" if rows.has("tx3") and rows.has("rx3") else "ss")
        staging.require(rows, stamps_of(protocol))
        self.usable, repeats, bits, counter = usable_exchanges(staging, rows, faults, good, stamps_of(protocol))
        faults.check(self.total)
        if repeats:
            self.notes.append(
                f"{repeats} of {self.total} rows repeat an exchange, with the same devices and stamps, and are left out"
            )
        if counter != "wrapped":
            self.notes.append(f"stamps are {counter}, and are taken modulo 2^{bits}")
        sample = self.usable.sample(SAMPLE_ROWS)
        self.reading = _reading(column_map, staging.paths[0], sample, Reading(protocol, bits), self.notes)
        raw = raw_range(exchanges_of(column_map, sample, self.reading))
        check_units(column_map, staging.paths[0], sample, raw)

    def write(self, path: str | os.PathLike[str], *, force: bool = False) -> tuple[dict[str, int], list[str]]:
        """Write a recording; returns the number of rows of each table that has any, and the notes.

        Raises what `Recording.create` raises.
        """
        notes, faults = self.notes, iter(self.faults)
        if count := len(self.faults) + sum(len(table.rejected()) for table in self.staging.tables):
            first = next(faults)
            rest = f"rows cannot be used and are kept as faults; the first: {first[0].detail}"
            notes, faults = [*notes, f"{count} of {self.total} {rest}"], chain([first], faults)
        counts = {"exchanges": 0, "poses": 0, "powers": 0, "faults": 0}
        with Recording.create(path, meta=self._meta(notes), force=force, memory_mb=250) as recording:
            recording.append_tags(Tag(tag, self._body(tag), (0.0, 0.0, 0.0)) for tag in self.usable.tags())
            for exchanges, powers in self._exchanges():
                with recording.transaction():
                    recording.append_exchanges(exchanges)
                    recording.append("powers", powers)
                counts["exchanges"] += len(exchanges)
                counts["powers"] += len(exchanges) if powers else 0
            for poses in self._poses():
                recording.append_poses(poses)
                counts["poses"] += len(poses)
            for some in faults:
                recording.append("faults", some)
                counts["faults"] += len(some)
        return {name: n for name, n in counts.items() if n or name == "exchanges"}, notes

    def contents(self) -> Contents:
        """Return the same in memory."""
        with TemporaryDirectory(prefix="uwblink-") as folder:
            path = Path(folder) / "imported.uwb"
            _, notes = self.write(path)
            return replace(load(path), meta=self._meta(notes))

    def _exchanges(self) -> Iterator[tuple[Exchanges, Columns]]:
        """Yield blocks of exchanges in the order of their rows, and their columns of the table `powers`."""
        before = 0
        for rows in self.usable.blocks():
            self.watch("writing", before / self.usable.count)
            exchanges = exchanges_of(self.staging.column_map, rows, self.reading, before)
            powers: Columns = {}
            if "rxp1" in rows or "rxp2" in rows:
                powers = {name: getattr(exchanges, name) for name in ("time_ns", "initiator", "target")}
                powers |= {f"{name}_dbm": optional(rows, name) for name in ("rxp1", "rxp2")}
            yield exchanges, powers
            before += len(exchanges)

    def _meta(self, notes: list[str]) -> dict[str, Any]:
        delays, names = self.staging.column_map.antenna_delays, self.staging.names
        if self.reading and self.reading.undelayed:
            delays = {None: AntennaDelay(0, 0, 0)}
        meta: dict[str, Any] = {
            **self._source,
            "timestamp_bits": self.reading.bits if self.reading else 32,
            "notes": notes,
        }
        if names:
            meta["tag_names"] = {str(number): name for number, name in sorted(names.items())}
        return meta | meta_of_delays(delays)

    def _body(self, tag: int) -> str:
        return self.staging.names.get(tag, f"tag{tag}")

    def _poses(self) -> Iterator[Poses]:
        """Yield the poses of antennas in order of time; antennas that never move have a single one."""
        rows, db = self.usable.rows, self.staging.db
        if not all(map(rows.has, POSITIONS)):
            return
        time = "time_ns" if rows.has("time_s") else f"(row_number() OVER () - 1) * {ROW_PERIOD_NS} AS time_ns"
        db.execute(
            f"CREATE TABLE located AS SELECT row, {time}, {', '.join(IDS)}, {', '.join(POSITIONS)} "
            f"FROM {rows.name} WHERE {self.usable.condition}"
        )
        ends = []
        for rank, (end, name) in enumerate(zip(("from", "to"), IDS, strict=True)):
            axes = ", ".join(f"{end}_{axis}_m AS {axis}" for axis in "xyz")
            known = " AND ".join(f"{end}_{axis}_m IS NOT NULL" for axis in "xyz")
            ends.append(f"SELECT time_ns, {name} AS tag, {rank} AS rank, row, {axes} FROM located WHERE {known}")
        # The first of several positions at one time counts; initiators come before targets.
        one = ", ".join(f"arg_min({axis}, (rank, row)) AS {axis}" for axis in "xyz")
        db.execute(f"CREATE TABLE places AS SELECT time_ns, tag, {one} FROM ({' UNION ALL '.join(ends)}) GROUP BY ALL")
        moves = " OR ".join(f"min({axis}) <> max({axis})" for axis in "xyz")
        db.execute(
            f"CREATE TABLE posed AS SELECT p.* FROM places p JOIN (SELECT tag, min(time_ns) AS first, {moves} AS moves "
            "FROM places GROUP BY tag) t ON p.tag = t.tag AND (t.moves OR p.time_ns = t.first) "
            "ORDER BY p.time_ns, p.tag"
        )
        for start in range(0, db.execute("SELECT count(*) FROM posed").fetchall()[0][0], ROWS_AT_ONCE):
            place = f"rowid >= {start} AND rowid < {start + ROWS_AT_ONCE}"
            found = db.execute(f"SELECT * FROM posed WHERE {place}").fetchnumpy()
            tags, which = np.unique(found["tag"], return_inverse=True)
            names = np.array([self._body(int(tag)) for tag in tags])
            level = np.tile([0.0, 0.0, 0.0, 1.0], (len(which), 1))
            position = np.column_stack([np.ma.getdata(found[axis]) for axis in "xyz"])
            yield Poses(np.ma.getdata(found["time_ns"]), names[which], position, level)


def note_on_repeats(rows: Columns) -> str:
    """Return a note if ranges without stamps are probably recorded twice; empty text otherwise.

    A range may equal the previous one of the same two devices by chance, or because it repeats it. In the first case
    the times since the previous range are distributed as those of other ranges: rank test of Mann and Whitney.
    """
    if "time_ns" not in rows:
        return ""
    one, other = (rows[name] for name in IDS)
    pair = np.minimum(one, other) * (LARGEST_ID + 1) + np.maximum(one, other)
    order = np.lexsort((rows["time_ns"], pair))
    same = np.diff(pair[order]) == 0
    gap = np.diff(rows["time_ns"][order])[same] * 1e-9
    equal = (np.diff(rows["range_m"][order]) == 0)[same]
    if equal.all() or not equal.any():
        return ""
    from scipy.stats import mannwhitneyu

    # False alarm for one in a million sound tables.
    if not mannwhitneyu(gap[equal], gap[~equal], alternative="less", method="asymptotic").pvalue < 1e-6:
        return ""
    after, others = (f"{1e3 * np.median(some):.3g} ms" for some in (gap[equal], gap[~equal]))
    return (
        f"{np.count_nonzero(equal)} of {len(pair)} ranges are exactly the one before of the same two devices, {after} "
        f"after it, and others after {others}: the table may hold exchanges twice, from the logs of both; all are kept"
    )
