"""Exchanges from a CSV file, plain or gzipped.

Every row is checked; a mistake names file, row and column. Ranges are
recomputed from the stamps. `gt_range_m`, or the distance between the two antenna positions
(`from_x_m` ... `to_z_m`), is stored beside the exchange as its measured truth.
"""

from __future__ import annotations

import csv
import gzip
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final, TextIO

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import LEVELS, POSITIONS, STAMP_UNITS, TIME_UNITS, ColumnMap, load_map
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.contents import Contents
from uwblink.recording.schema import Tag
from uwblink.twr import LARGEST_ID, LATEST_NS, STAMPS, Exchanges, raw_range

REQUIRED: Final = ("time_s", "from_id", "to_id", *STAMPS[:4])


def read_csv(source: Path, map_file: Path | None = None) -> Contents:
    """Return the exchanges of a table, in the order of its rows, and a tag at the origin of a body each.

    `map_file` says what its columns are called (see `column_map`). Raises `ImportTableError`.
    """
    column_map = load_map(map_file) if map_file else ColumnMap()
    exchanges = _Table(source, column_map).exchanges()
    ids = sorted({*exchanges.initiator.tolist(), *exchanges.target.tolist()})
    meta = {"source": "import csv", "imported_from": source.name, "timestamp_bits": column_map.bits}
    return Contents(exchanges=exchanges, tags=[Tag(i, f"tag{i}", (0.0, 0.0, 0.0)) for i in ids], meta=meta)


@contextmanager
def _opened(path: Path) -> Iterator[TextIO]:
    if path.is_dir():
        raise ImportTableError(f"{path}: is a directory, expected a table (.csv or .csv.gz)")
    try:
        opener = gzip.open if path.suffix == ".gz" else open
        with opener(path, "rt", encoding="utf-8-sig", newline="") as file:
            yield file
    except FileNotFoundError as error:
        raise ImportTableError(f"{path}: no such table") from error
    except UnicodeDecodeError as error:
        raise ImportTableError(f"{path}: not a text file in UTF-8") from error
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise ImportTableError(f"{path}: broken or truncated gzip ({error})") from error
    except csv.Error as error:
        raise ImportTableError(f"{path}: not a CSV table ({error})") from error
    except OSError as error:
        raise ImportTableError(f"{path}: cannot be read ({error.strerror})") from error


class _Table:
    """The cells of a table by column, as text, and the readers of each kind of column."""

    def __init__(self, path: Path, column_map: ColumnMap) -> None:
        self._path, self._map = path, column_map
        with _opened(path) as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            self._check_header(header)
            rows, self._lines = [], []
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise ImportTableError(
                        f"{path}: row {reader.line_num}: found {len(row)} cells, the header has {len(header)}"
                    )
                rows.append(row)
                self._lines.append(reader.line_num)
        if not rows:
            raise ImportTableError(f"{path}: a header and no rows")
        self._cells = dict(zip(header, zip(*rows, strict=True), strict=True))

    def exchanges(self) -> Exchanges:
        """Return all rows, checked."""
        has_third = self._has("tx3") and self._has("rx3")
        protocol = self._map.protocol or ("ds" if has_third else "ss")
        messages = len(PROTOCOLS[protocol].messages)
        if messages == 3 and not has_third:
            raise self._missing("tx3" if not self._has("tx3") else "rx3")
        initiator, target = (self._integers(n, LARGEST_ID) for n in ("from_id", "to_id"))
        self._reject("to_id", initiator == target, "the same tag as from_id")
        time = self._numbers("time_s") * TIME_UNITS[self._map.time_unit]
        self._reject("time_s", np.abs(time) > LATEST_NS, "a time")
        count = len(time)
        stamps = {name: self._stamps(name) for name in STAMPS[: 2 * messages]}
        none = np.zeros(count, dtype=np.int64)
        fpp1, fpp2, skew1, skew2, truth = (self._optional(name) for name in LEVELS)
        exchanges = Exchanges(
            time_ns=np.rint(time).astype(np.int64),
            initiator=initiator,
            target=target,
            protocol=np.full(count, protocol),
            reporter=initiator,
            range_m=np.zeros(count),
            fpp1_dbm=fpp1,
            fpp2_dbm=fpp2,
            skew1_ppm=skew1,
            skew2_ppm=skew2,
            truth_m=truth if self._has("gt_range_m") else self._distance(),
            bits=self._map.bits,
            **{name: stamps.get(name, none) for name in STAMPS},
        )
        exchanges.range_m[:] = raw_range(exchanges)
        return exchanges

    def _check_header(self, header: list[str]) -> None:
        if not any(header):
            raise ImportTableError(f"{self._path}: empty, expected a header and rows")
        for name in header:
            if header.count(name) > 1:
                raise ImportTableError(f"{self._path}: row 1: two columns are called {name!r}")
        self._header = header
        for name in REQUIRED:
            if not self._has(name):
                raise self._missing(name)
        for name in self._map.columns:
            if not self._has(name):
                raise self._missing(name)

    def _has(self, name: str) -> bool:
        return name in self._map.constants or self._map.header(name) in self._header

    def _missing(self, name: str) -> ImportTableError:
        return ImportTableError(
            f"{self._path}: column {self._map.header(name)!r} is missing; there are "
            f"{', '.join(self._header)}; a `map_file` can rename columns or give constants"
        )

    def _numbers(self, name: str) -> Floats:
        if name in self._map.constants:
            return np.full(len(self._lines), self._map.constants[name])
        cells = self._cells[self._map.header(name)]
        try:
            values = np.array(cells, dtype=np.float64)
        except ValueError:
            values = np.array([_float(cell) for cell in cells])
        self._reject(name, ~np.isfinite(values), "a finite number")
        return values

    def _optional(self, name: str) -> Floats:
        return self._numbers(name) if self._has(name) else np.full(len(self._lines), np.nan)

    def _integers(self, name: str, largest: int) -> Ints:
        values = self._numbers(name)
        bad = (values != np.rint(values)) | (values < 0) | (values > largest)
        self._reject(name, bad, f"a whole number from 0 to {largest}")
        return values.astype(np.int64)

    def _stamps(self, name: str) -> Ints:
        largest = (1 << self._map.bits) - 1
        if self._map.stamp_unit == "ticks":
            return self._integers(name, largest)
        ticks = np.rint(self._numbers(name) * STAMP_UNITS[self._map.stamp_unit])
        self._reject(name, (ticks < 0) | (ticks > largest), f"a stamp of {self._map.bits} bits")
        return ticks.astype(np.int64)

    def _distance(self) -> Floats:
        if not all(self._has(name) for name in POSITIONS):
            return np.full(len(self._lines), np.nan)
        ends = np.array([self._numbers(name) for name in POSITIONS])
        return np.asarray(np.sqrt(((ends[3:] - ends[:3]) ** 2).sum(axis=0)))

    def _reject(self, name: str, bad: Bools, expected: str) -> None:
        if not bad.any():
            return
        row = int(np.argmax(bad))
        header = self._map.header(name)
        found = self._cells[header][row] if header in self._cells else self._map.constants[name]
        raise ImportTableError(
            f"{self._path}: row {self._lines[row]}, column {header!r}: found {str(found)[:40]!r}, expected {expected}"
        )


def _float(cell: str) -> float:
    try:
        return float(cell)
    except ValueError:
        return float("nan")
