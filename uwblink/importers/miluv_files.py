"""The tables of a MILUV flight as columns of a recording's tables: stamps as ticks, rows once, in order of time."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.stamps import NEVER, clocks, to_ticks, whole
from uwblink.importers.table import Table
from uwblink.recording.schema import CirRow, Fault, Poses
from uwblink.ticks import REPORT_BITS, TICKS_PER_SECOND
from uwblink.twr import STAMPS, Exchanges

Columns = dict[str, NDArray[Any]]

_POSITION: Final = tuple(f"pose.position.{axis}" for axis in "xyz")
_ATTITUDE: Final = tuple(f"pose.orientation.{axis}" for axis in "xyzw")
_IMU: Final = {
    **{f"w{axis}": f"angular_velocity.{axis}" for axis in "xyz"},
    **{f"a{axis}": f"linear_acceleration.{axis}" for axis in "xyz"},
}
_LEVELS: Final = {"fpp1_dbm": "fpp1", "fpp2_dbm": "fpp2", "skew1_ppm": "skew1", "skew2_ppm": "skew2"}
_OVERHEARD: Final = {
    **{f"fpp{k}_dbm": f"fpp{k}" for k in (1, 2, 3)},
    **{f"skew{k}_ppm": f"skew{k}" for k in (1, 2, 3)},
    **{f"fpp{k}_n_dbm": f"fpp{k}_n" for k in (1, 2)},
    **{f"skew{k}_n_ppm": f"skew{k}_n" for k in (1, 2)},
}
_LISTENER_STAMPS: Final = ("rx1", "rx2", "rx3")
_CLOCKS: Final = clocks("ds")
_OPTIONAL: Final = ("_dbm", "_ppm", "measured_m")


@dataclass(slots=True)
class Flight:
    """A folder, its robots' folders, and what was found in them that is no row: doubled ones by file, and faults.

    Times are nanoseconds since the clock of the folder began.
    """

    folder: Path
    robots: tuple[Path, ...]
    doubled: dict[str, int] = field(default_factory=dict)
    faults: list[Fault] = field(default_factory=list)


def open_flight(folder: Path) -> Flight:
    """Find the robots of a folder; raises `ImportTableError` where there are none."""
    if not folder.is_dir():
        raise ImportTableError(
            f"{folder}: no such folder; expected one with a folder a robot (ifo001/uwb_range.csv ...)"
        )
    found = tuple(sorted(path.parent for path in folder.glob("*/uwb_range.csv")))
    if not found:
        raise ImportTableError(f"{folder}: no folder in it holds uwb_range.csv, as those of MILUV's robots do")
    return Flight(folder, found)


def read_exchanges(flight: Flight) -> tuple[Exchanges, Floats]:
    """Return all exchanges in order of time, without truth, and the distances that the authors measured (n,)."""
    columns: dict[str, Any] = _collected(flight, "uwb_range.csv", _exchange_rows, ("initiator", "target", "tx1", "rx1"))
    if not columns:
        raise ImportTableError(f"{flight.folder}: its uwb_range.csv hold no row that can be used")
    measured = columns.pop("measured_m")
    count = len(measured)
    exchanges = Exchanges(
        protocol=np.full(count, "ds"), reporter=columns["initiator"], truth_m=np.full(count, np.nan), **columns
    )
    return exchanges, measured


def _exchange_rows(table: Table) -> Columns:
    raw = "_raw" if "tx1_raw" in table.names else ""
    cells = _cells(
        table,
        ("timestamp", "from_id", "to_id", f"range{raw}", *(f"{n}{raw}" for n in STAMPS)),
        ("gt_range", *_LEVELS.values()),
    )
    return {
        **_ends(cells, {"initiator": "from_id", "target": "to_id"}),
        **_ticks(cells, {name: f"{name}{raw}" for name in STAMPS}, _CLOCKS),
        "range_m": cells[f"range{raw}"],
        "measured_m": cells["gt_range"],
        **{name: cells[column] for name, column in _LEVELS.items()},
    }


def read_overheard(flight: Flight) -> Columns:
    """Return passively heard exchanges, columns of the table `overheard`; nothing where there are none."""
    return _collected(flight, "uwb_passive.csv", _overheard_rows, ("listener", "initiator", "target", "rx1"))


def _overheard_rows(table: Table) -> Columns:
    raw = "_raw" if "rx1_raw" in table.names else ""
    own = {name: f"{name}{raw}" for name in _LISTENER_STAMPS}
    neighbours = {f"{name}_n": f"{name}{raw}_n" for name in STAMPS}
    ids = {"listener": "my_id", "initiator": "from_id", "target": "to_id"}
    required = ("timestamp", *ids.values(), *own.values(), *neighbours.values())
    cells = _cells(table, required, tuple(_OVERHEARD.values()))
    by_clock = (_LISTENER_STAMPS, *(tuple(f"{name}_n" for name in clock) for clock in _CLOCKS))
    return {
        **_ends(cells, ids),
        **_ticks(cells, own | neighbours, by_clock),
        **{name: cells[column] for name, column in _OVERHEARD.items()},
    }


def read_cirs(flight: Flight) -> Columns:
    """Return impulse responses, columns of the table `cirs`; nothing where there are none."""
    return _collected(flight, "uwb_cir.csv", _cir_rows, ("board", "initiator", "target"))


def cir_rows(columns: Columns) -> list[CirRow]:
    """Return the columns of `read_cirs` as rows."""
    if not columns:
        return []
    whole = [columns[name].tolist() for name in ("time_ns", "board", "initiator", "target")]
    taps = [tuple(row.tolist()) for row in columns["magnitudes"]]
    return [CirRow(*row) for row in zip(*whole, columns["first_path_index"].tolist(), taps, strict=True)]


def _cir_rows(table: Table) -> Columns:
    ids = {"board": "my_id", "initiator": "from_id", "target": "to_id"}
    cells = _cells(table, ("timestamp", *ids.values(), "idx"), ())
    taps = table.lists("cir")
    return {
        **_ends(cells, ids),
        "first_path_index": np.where([row is None for row in taps], np.nan, cells["idx"]),
        "magnitudes": taps,
    }


def read_imu(flight: Flight) -> Columns:
    """Return what the robots' inertial sensors read, columns of the table `imu`; nothing where there are none."""
    return _readings(flight, "imu_px4.csv", _IMU)


def read_heights(flight: Flight) -> Columns:
    """Return what the robots' height sensors read, columns of the table `height`; nothing where there are none."""
    return _readings(flight, "height.csv", {"height_m": "range"})


def _readings(flight: Flight, name: str, columns: Mapping[str, str]) -> Columns:
    """Return what a sensor of each robot read, in order of time; nothing where no robot has the file."""

    def read(table: Table) -> Columns:
        cells = _cells(table, ("timestamp", *columns.values()), ())
        body = np.full(len(cells["timestamp"]), table.path.parent.name)
        return {"time_ns": _time_ns(cells), "body": body, **{n: cells[c] for n, c in columns.items()}}

    return _collected(flight, name, read, None)


def read_poses(flight: Flight) -> Poses:
    """Return the poses of the robots, none where there is no motion capture."""
    columns = _readings(flight, "mocap.csv", {name: name for name in (*_POSITION, *_ATTITUDE)})
    if not columns:
        return Poses(np.empty(0, np.int64), np.empty(0, np.str_), np.empty((0, 3)), np.empty((0, 4)))
    attitude = np.column_stack([columns[name] for name in _ATTITUDE])
    norm = np.linalg.norm(attitude, axis=1)
    good = (norm > 0.9) & (norm < 1.1)
    for row in np.flatnonzero(~good):
        detail = f"{columns['body'][row]}/mocap.csv: a quaternion of length {norm[row]:.3g}"
        flight.faults.append(Fault(int(columns["time_ns"][row]), "mocap.csv", "unusable row", detail))
    position = np.column_stack([columns[name] for name in _POSITION])
    return Poses(columns["time_ns"][good], columns["body"][good], position[good], attitude[good] / norm[good, None])


def _collected(flight: Flight, name: str, read: Callable[[Table], Columns], key: tuple[str, ...] | None) -> Columns:
    """Return the rows of all robots' files of one name in order of time, each once by `key` and time.

    Rows in which a number is missing that is needed go to the faults.
    """
    parts: list[Columns] = []
    for robot in flight.robots:
        path = robot / name
        if not path.exists():
            continue
        with Table(path) as table:
            columns = read(table)
        good = _usable(columns)
        for row in np.flatnonzero(~good):
            detail = f"{robot.name}/{name}: row {row + 2}: a number is missing or none"
            flight.faults.append(Fault(0, name, "unusable row", detail))
        parts.append({n: column[good] for n, column in columns.items()})
    if not sum(len(part["time_ns"]) for part in parts):
        return {}
    joined = {n: np.concatenate([part[n] for part in parts]) for n in parts[0]}
    order = np.argsort(joined["time_ns"], kind="stable")
    if key is not None:
        rows = np.column_stack([joined[n][order] for n in ("time_ns", *key)])
        first = np.sort(np.unique(rows, axis=0, return_index=True)[1])
        flight.doubled[name] = len(order) - len(first)
        order = order[first]
    return {n: column[order] for n, column in joined.items()}


def _usable(columns: Columns) -> Bools:
    """Return which rows have every number that is needed, (n,)."""
    good = np.ones(len(columns["time_ns"]), dtype=bool)
    for name, column in columns.items():
        if column.dtype.kind == "i":
            good &= column != NEVER
        elif column.dtype.kind == "f" and not name.endswith(_OPTIONAL):
            good &= np.isfinite(column)
    return good


def _cells(table: Table, required: Iterable[str], optional: Iterable[str]) -> dict[str, Floats]:
    """Return columns as numbers; those that are optional are NaN where the table does not have them."""
    extra = list(optional)
    needed = list(required)
    cells = table.numbers([*needed, *(name for name in extra if name in table.names)])
    count = len(cells[needed[0]])
    return cells | {name: np.full(count, np.nan) for name in extra if name not in cells}


def _time_ns(cells: dict[str, Floats]) -> Ints:
    return whole(cells["timestamp"] * 1e9)


def _ends(cells: dict[str, Floats], ids: Mapping[str, str]) -> Columns:
    """Return time and ids; an id that is none makes its row unusable."""
    found: Columns = {"time_ns": _time_ns(cells)}
    for name, column in ids.items():
        values = cells[column]
        with np.errstate(invalid="ignore"):
            good = (values >= 0) & (values <= 65_535) & (values == np.rint(values))
        found[name] = whole(np.where(good, values, np.nan))
    return found


def _ticks(cells: dict[str, Floats], names: Mapping[str, str], by_clock: Iterable[tuple[str, ...]]) -> Columns:
    """Return stamps in unwrapped nanoseconds as ticks of the boards' counter."""
    named = {name: cells[column] for name, column in names.items()}
    return {**to_ticks(named, by_clock, TICKS_PER_SECOND * 1e-9, REPORT_BITS)}
