"""Tables of exchanges, of messages or of plain ranges, one file or several, written to a recording.

The steps: stage the tables, combine the rows of each exchange and record unusable rows as faults (`staging`), determine
the meaning of stamps (`plausibility`), write the exchanges in blocks. A table is refused if half of its rows or more
are unusable. `range_m` is the range reported by the device, or else the range by the stamps. `gt_range_m`, or the
distance between the two antenna positions (`from_x_m` ... `to_z_m`), is stored as the true distance of the exchange;
antennas with positions become bodies with poses.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from uwblink.arrays import Columns
from uwblink.display import first_few
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import (
    ALL_IDS,
    DISTANCES,
    IDS,
    NAMES,
    POSITIONS,
    POWERS,
    SIGN,
    SKEWS,
    TEMPERATURES,
    ColumnMap,
    load_map,
)
from uwblink.importers.forms import NOT_READ, named_columns
from uwblink.importers.plausibility import (
    MIN_ROWS,
    ROW_PERIOD_NS,
    SAMPLE_ROWS,
    Reading,
    check_units,
    exchanges_of,
    optional,
    settle_reading,
    stamps_of,
)
from uwblink.importers.staging import (
    OF_DIFFERENCES,
    SOUND_IDS,
    Condition,
    StagedRows,
    Staging,
    Watch,
    assemble_exchanges,
    broadcast_exchanges,
    in_time_order,
    rows_back,
    time_conditions,
    usable_exchanges,
)
from uwblink.importers.tables import connected
from uwblink.importers.templates import Template
from uwblink.recording.antenna_delays import ALL, AntennaDelay, meta_of_delays
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag, standard_meta
from uwblink.twr import STAMPS, Exchanges, raw_range

TABLE_SUFFIXES: Final = (".csv", ".csv.gz", ".tsv", ".parquet", ".jsonl", ".ndjson", ".jsonl.gz")

_BESIDE: Final = {
    "powers": {"rxp1": "rxp1_dbm", "rxp2": "rxp2_dbm"},
    "quality": {"sts1": "sts1", "sts2": "sts2"},
}
"""Tables with one row per exchange, and their columns by columns of maps."""


@dataclass(frozen=True, slots=True)
class Imported:
    """Result of an import: the number of rows by table, exchanges first, and notes for the user."""

    counts: dict[str, int]
    notes: list[str]


def find_tables(sources: Sequence[Path], map_file: Path | None, _folder: Path) -> tuple[list[Path], ColumnMap]:
    """Return the tables of a folder, or several files, and the map of their columns; raises `ImportTableError`."""
    paths, column_map = list(sources), load_map(map_file) if map_file else ColumnMap()
    if len(paths) == 1 and paths[0].is_dir():
        paths = tables_in(paths[0], column_map)
    if column_map.topics:
        raise ImportTableError(f"{map_file}: [topics] can only be used with bags; {paths[0]} is a table")
    return paths, column_map


def tables_in(folder: Path, column_map: ColumnMap) -> list[Path]:
    """Return the files of a folder that are tables or logs by their names, in order; raises `ImportTableError`.

    A template of names (`from_name`) selects matching files, also in subfolders.
    """
    name = Template(column_map.from_name) if column_map.from_name else None
    suffixes = TABLE_SUFFIXES + ((".txt", ".log", ".dat", ".txt.gz", ".log.gz") if column_map.line else ())
    inner = folder.rglob("*") if name and "/" in name.text else folder.iterdir()
    paths = sorted(p for p in inner if (name.match(p.as_posix()) if name else p.name.lower().endswith(suffixes)))
    if not paths:
        wanted = f"named {column_map.from_name!r}" if name else f"({', '.join(suffixes)})"
        raise ImportTableError(f"{folder}: is a directory without a table {wanted}")
    return paths


def import_tables(
    paths: Sequence[Path],
    column_map: ColumnMap,
    output: Path,
    meta: Mapping[str, Any],
    watch: Watch,
    *,
    force: bool = False,
) -> Imported:
    """Write the exchanges of tables to a recording, and add to its `meta`.

    Raises `ImportTableError`, and what `Recording.create` raises.
    """
    with connected(paths) as db:
        staging = Staging(db, paths, column_map, watch)
        _note_assumptions(staging)
        rows, reading = _usable(staging)
        total, done = rows.count(), 0
        delays = column_map.antenna_delays
        if reading and reading.undelayed:
            delays = {None: AntennaDelay(0, 0, 0)}
        names = {str(tag): name for tag, name in sorted(staging.names.items())}
        meta = {**meta, "timestamp_bits": reading.bits if reading else 32, **meta_of_delays(delays)}
        meta |= {"tag_names": names} if names else {}
        meta |= {"chip": column_map.chip} if column_map.chip else {}
        if rows.has("difference_m") and not delays:  # without stamps: programmed delays are not in them
            meta = {key: value for key, value in standard_meta().items() if key != ALL} | meta
        with Recording.create(output, meta=meta, force=force, memory_mb=250) as recording:
            ids = [name for name in ALL_IDS if rows.has(name)]
            ends = " UNION ".join(f"SELECT {name} AS id FROM {rows.name} WHERE {rows.condition}" for name in ids)
            tags = db.execute(f"{ends} ORDER BY id").fetchall()
            bodies = {tag: staging.names.get(tag, f"tag{tag}") for (tag,) in tags}
            recording.append("tags", [Tag(tag, body, (0.0, 0.0, 0.0)) for tag, body in bodies.items()])
            for block in rows.blocks():
                watch("writing", done / total)
                exchanges = exchanges_of(column_map, block, reading, done)
                done += len(exchanges)
                if reading is None and rows.has("difference_m"):
                    named = {"minus": "from_id", "plus": "to_id", "listener": "at_id", "difference_m": "difference_m"}
                    values = {kept: block[name] for kept, name in named.items()}
                    recording.append("differences", {"time_ns": exchanges.time_ns} | values)
                    continue
                if not np.isfinite(exchanges.range_m).all():
                    raw, reported = raw_range(exchanges), exchanges.range_m
                    exchanges = replace(exchanges, range_m=np.where(np.isfinite(reported), reported, raw))
                recording.append("exchanges", exchanges)
                for table, beside in _other_rows(exchanges, block):
                    recording.append(table, beside)
            for poses in _poses(rows, bodies):
                recording.append("poses", poses)
            for table, found in staging.beside.items():
                recording.append(table, found)
            first = ""
            for some in staging.faults:
                first = first or some[0].detail
                recording.append("faults", some)
            counts = {
                name: recording.count(name)
                for name in ("exchanges", "differences", "poses", "temperature", *_BESIDE, *staging.beside, "faults")
            }
            if first:
                lost = counts["faults"]
                staging.notes.append(
                    f"{lost} of {total + lost} rows are unusable and stored as faults; the first: {first}"
                )
            recording.append_meta({"notes": staging.notes})
        return Imported({name: n for name, n in counts.items() if n or name == "exchanges"}, staging.notes)


def _other_rows(exchanges: Exchanges, block: Columns) -> Iterator[tuple[str, Columns]]:
    """Yield the other contents of rows, by table of the recording."""
    for table, columns in _BESIDE.items():
        if columns.keys() & block.keys():
            ends = {name: getattr(exchanges, name) for name in ("time_ns", "initiator", "target")}
            yield table, ends | {kept: optional(block, name) for name, kept in columns.items()}
    for end, name in zip(("initiator", "target"), TEMPERATURES, strict=True):
        if name in block:
            read = {"time_ns": exchanges.time_ns, "tag": getattr(exchanges, end), "temperature_c": block[name]}
            read |= {"supply_v": np.full(len(exchanges), np.nan)}
            yield "temperature", {kept: column[np.isfinite(block[name])] for kept, column in read.items()}


def _note_assumptions(staging: Staging) -> None:
    """Add notes on ids that are words, on rows without a range, and on times that are assumed."""
    if names := {number: name for number, name in staging.names.items() if name not in staging.column_map.ids}:
        # The first dozen; the recording has all, as bodies of its tags.
        some = first_few((f"{name[:20]} = {number}" for number, name in names.items()), 12)
        staging.notes.append(
            f"{len(names)} ids are words or too large, and were numbered: {some}; another file may get other numbers, "
            f"so give them in [ids] of the map if you use several files"
        )
    if staging.blanks:
        total = staging.offsets[-1]
        staging.notes.append(f"{staging.blanks} of {total} rows or cells have no range, and are left out")
    if not staging.rows.has("time_s"):
        rows = "rows are assumed to be one millisecond apart, in their order"
        timed = "frames are timed by their stamps" if staging.column_map.layout == "broadcasts" else rows
        staging.notes.append(f"there are no times; {timed}")


def _usable(staging: Staging) -> tuple[StagedRows, Reading | None]:
    """Return the usable exchanges and the reading of their stamps, None for ranges without stamps; adds notes.

    Raises `ImportTableError` if half of the rows or more are unusable.
    """
    column_map, path, faults, notes = staging.column_map, staging.paths[0], staging.faults, staging.notes
    if (back := rows_back(staging.rows))[0]:
        # Rows of one log are out of order by less; each of several files restarts the time.
        more = (
            f"; times go back by up to {back[1]:.1f} s: if the clock was set back, or the table contains several "
            f"recordings, import the parts separately"
        ) * (back[1] > 1 and len(staging.paths) == 1)
        notes.append(f"{back[0]} rows are earlier than the row before, and are sorted by time{more}")
    layout, protocol = column_map.layout or _layout(staging), column_map.protocol
    if layout == "broadcasts":
        rows, protocol = broadcast_exchanges(staging)
    elif layout in ("messages", "stamps", "parts"):
        rows, found = assemble_exchanges(staging, layout)
        protocol = protocol or found
    else:
        rows = faults.reject(staging.rows, SOUND_IDS)
    if layout not in ("exchanges", "ranges", "parts") and any(map(staging.rows.has, TEMPERATURES)):
        notes.append(f"temperatures are only read if a row is an exchange, not with layout {layout}")
    notes += _unread_columns(staging, layout)
    total = rows.count() + len(faults)
    staging.watch("checking", 0.0)
    value = {"ranges": "range_m", "differences": "difference_m"}.get(layout)
    notes += staging.words_in(
        name for name in (*DISTANCES, *POWERS, *SKEWS, *TEMPERATURES, *_BESIDE["quality"]) if name != value
    )
    if not any(map(rows.has, ("fpp1", "fpp2"))) and any(map(rows.has, ("rxp1", "rxp2"))):
        notes.append("there is no first-path power; the received power is used instead")
    if value:
        of_differences = OF_DIFFERENCES if layout == "differences" else ()
        staging.require(rows, [value, *(["at_id"] if of_differences else [])])
        sound = (*time_conditions(rows), *of_differences, Condition(value, "a finite number", f"{value} IS NULL"))
        rows = faults.reject(rows, sound)
        faults.check(total)
        check_units(column_map, path, rows.sample(SAMPLE_ROWS), None)
        if of_differences:
            ends = ", ".join(f"{name} is {column_map.header(name)!r:.60}" for name in ("to_id", "from_id"))
            notes.append(f"{SIGN} ({ends}): exchange the two in a map if the log has the opposite sign")
            return in_time_order(rows), None
        rows, note = _without_repeats(in_time_order(rows))
        notes += filter(None, [note])
        return rows, None
    protocol = protocol or ("ds" if rows.has("tx3") and rows.has("rx3") else "ss")
    staging.require(rows, stamps_of(protocol))
    rows, repeats, bits, counter = usable_exchanges(staging, rows, stamps_of(protocol))
    faults.check(total)
    if repeats:
        notes.append(
            f"{repeats} of {total} rows repeat an exchange, with the same devices and stamps, and are left out"
        )
    if counter != "wrapped":
        notes.append(f"stamps are {counter}, and are taken modulo 2^{bits}")
    sample = rows.sample(SAMPLE_ROWS)
    reading, note = settle_reading(path, column_map, sample, Reading(protocol, bits))
    notes += filter(None, [note])
    check_units(column_map, path, sample, raw_range(exchanges_of(column_map, sample, reading)))
    return in_time_order(rows), reading


def _unread_columns(staging: Staging, layout: str) -> Iterator[str]:
    """Yield a note on columns that are not read, if no map names columns and their names resemble those of a map."""
    foreign = NOT_READ.get(layout, NOT_READ["exchanges"])
    read = set(NAMES) - set(foreign)
    found = {
        header: name
        for name, header in named_columns(staging.tables[0].names).items()
        if not (header in read or name in foreign or staging.rows.has(name))
    }
    if found and not staging.column_map.columns:
        named = first_few((f"{header!r:.60} ({name}?)" for header, name in found.items()), 6)
        yield f"these columns are not read: {named}; name them in a map, which `uwblink import guess` proposes"


def _layout(staging: Staging) -> str:
    """Return the layout that the columns suggest."""
    has = staging.rows.has
    needed = {"exchanges": STAMPS[:4], "messages": ("tx", "rx"), "stamps": ("stamp", "event")}
    needed |= {} if any(map(has, STAMPS)) else {"ranges": ("range_m",), "differences": ("difference_m",)}
    for layout, names in needed.items():
        if all(map(has, names)):
            return layout
    lacking = next(name for name in STAMPS if not has(name)) if any(map(has, STAMPS)) else "range_m"
    raise staging.tables[0].missing(staging.column_map.header(lacking))


def _poses(rows: StagedRows, bodies: Mapping[int, str]) -> Iterator[Poses]:
    """Yield the poses of antennas in order of time; antennas that never move have a single one."""
    if not all(map(rows.has, POSITIONS)):
        return
    time = "time_ns" if rows.has("time_s") else f"(row_number() OVER () - 1) * {ROW_PERIOD_NS} AS time_ns"
    located = f"SELECT {time}, rowid AS row, {', '.join((*IDS, *POSITIONS))} FROM {rows.name} WHERE {rows.condition}"
    ends = (
        f"SELECT time_ns, {name} AS tag, {rank} AS rank, row, "
        f"{', '.join(f'{end}_{axis}_m AS {axis}' for axis in 'xyz')} FROM located"
        for rank, (end, name) in enumerate(zip(("from", "to"), IDS, strict=True))
    )
    # The first of several positions at one time is used; initiators are before targets.
    one = ", ".join(f"arg_min({axis}, (rank, row)) AS {axis}" for axis in "xyz")
    moves = " OR ".join(f"min({axis}) OVER tags <> max({axis}) OVER tags" for axis in "xyz")
    rows.db.execute(
        f"CREATE TABLE posed AS WITH located AS MATERIALIZED ({located}), places AS (SELECT time_ns, tag, {one} "
        f"FROM ({' UNION ALL '.join(ends)}) WHERE x + y + z IS NOT NULL GROUP BY ALL) "
        f"SELECT time_ns AS origin, tag, x, y, z FROM places WINDOW tags AS (PARTITION BY tag) "
        f"QUALIFY {moves} OR time_ns = min(time_ns) OVER tags ORDER BY time_ns, tag"
    )
    for found in StagedRows(rows.db, "posed", ("origin", "tag", "x", "y", "z")).blocks():
        tags, which = np.unique(found["tag"], return_inverse=True)
        position = np.column_stack([found[axis] for axis in "xyz"])
        names = np.array([bodies[int(tag)] for tag in tags])[which]
        yield Poses(found["origin"], names, position, np.tile([0.0, 0.0, 0.0, 1.0], (len(which), 1)))


def _without_repeats(rows: StagedRows) -> tuple[StagedRows, str]:
    """Return ranges without stamps, without those that the other device of an exchange also logged, and a note on
    repeats.

    A range may equal the previous one of the same two devices by chance, or as a repetition. By chance, the time since
    the previous range is as usual; a repetition follows sooner.
    """
    if not rows.has("time_s"):
        return rows, ""
    pair = "PARTITION BY least(from_id, to_id), greatest(from_id, to_id) ORDER BY time_ns, rowid"
    gaps = (
        "SELECT rowid AS row, (time_ns - lag(time_ns) OVER pair) * 1e-6 AS gap_ms, range_m = lag(range_m) OVER pair "
        f"AS equal, from_id <> lag(from_id) OVER pair AS turned FROM {rows.name} WHERE {rows.condition} "
        f"WINDOW pair AS ({pair})"
    )
    medians = (f"coalesce(median(gap_ms) FILTER ({which}), 0)" for which in ("equal", "NOT equal"))
    counts = "count(*) FILTER (equal), count(*) FILTER (equal AND turned)"
    ((count, turned, after, others),) = rows.db.execute(
        f"SELECT {counts}, {', '.join(medians)} FROM ({gaps})"
    ).fetchall()
    if count < MIN_ROWS or after >= others / 2:
        return rows, ""
    text = f"of {rows.count()} ranges repeat the one before of the same two devices, {after:.3g} ms after it"
    if 2 * turned < count:
        return rows, f"{count} {text}, others follow after {others:.3g} ms: some may be logged twice; all are kept"
    rows.db.execute(
        f"CREATE TABLE repeats AS SELECT row FROM ({gaps}) WHERE equal AND turned AND gap_ms < {others / 2!r}"
    )
    merged = StagedRows(rows.db, "repeats", ()).count()
    kept = rows.where("rowid NOT IN (SELECT row FROM repeats)")
    return kept, f"{merged} {text}, as logged by the other device, and are left out"
