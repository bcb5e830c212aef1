"""Tables of strangers as rows of which little is in memory: each file is parsed once, and its columns are put aside.

What all rows decide - whether ids are words, whether times are - is asked of what was put aside.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Ints
from uwblink.errors import ImportTableError
from uwblink.importers.column_map import IDS, ColumnMap
from uwblink.importers.ids import Numbering, is_id, numbering, too_many
from uwblink.importers.row_faults import faults_of, too_long
from uwblink.importers.staged_file import StagedFile, missing_column
from uwblink.importers.staging import Kept, Stage
from uwblink.importers.table_rows import ROWS_AT_ONCE, Rows, joined
from uwblink.importers.unusable import Reason, Unusable
from uwblink.recording.schema import Fault

MOST_WORDS: Final = 1_000_000
"""Different words, more than ids can be written in."""

Watch = Callable[[str, float], object]
"""Is told what is being done, and which share of it is."""


class StagedTables:
    """The rows of several files as one table. Close it, or use it as a context manager."""

    def __init__(self, paths: Sequence[Path], column_map: ColumnMap, watch: Watch | None = None) -> None:
        """Read the columns that a map names, and those that have our names; raises `ImportTableError`."""
        self.paths, self.column_map = tuple(paths), column_map
        self._stage = Stage(paths)
        try:
            self._files: list[StagedFile] = []
            for k, path in enumerate(paths):
                if watch:
                    watch("reading", k / len(paths))
                self._files.append(StagedFile(path, column_map, self._stage, k))
            self._check_alike()
            self._numbering = self._numbered()
            if self._numbering.known is None:
                for file in self._files:
                    file.words.clear()
        except BaseException:
            self._stage.close()
            raise
        self._offsets = np.cumsum([0, *(file.kept.count for file in self._files)])

    def __enter__(self) -> StagedTables:
        """Return the tables themselves."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Forget everything."""
        self._stage.close()

    def __len__(self) -> int:
        """Return the number of rows."""
        return int(self._offsets[-1])

    @property
    def names(self) -> dict[int, str]:
        """The ids that were words, by number."""
        return self._numbering.names

    @property
    def stage(self) -> Stage:
        """Where more can be put aside."""
        return self._stage

    def has(self, name: str) -> bool:
        """Return whether there is a column of one of `NAMES`."""
        if name in self._files[0].headers:
            return True
        told = self.column_map.constants.get(name)
        # A word that is a number is no name.
        return told is not None and not (isinstance(told, str) and self._numbering.known is None)

    def blocks(self, names: Collection[str] | None = None) -> Iterator[Rows]:
        """Yield all rows in their order, some at a time, with the cells of some columns (None: of all)."""
        for k, file in enumerate(self._files):
            for start in range(0, file.kept.count, ROWS_AT_ONCE):
                stop = min(start + ROWS_AT_ONCE, file.kept.count)

                def piece(
                    kept: Kept, columns: Collection[str], start: int = start, stop: int = stop
                ) -> dict[str, NDArray[Any]]:
                    return kept.between(start, stop, columns)

                yield file.rows(names, piece, self._offsets[k] + np.arange(start, stop), self._numbering)

    def at(self, places: Ints, names: Collection[str]) -> Rows:
        """Return the rows at some places, in ascending order without repetition, with the cells of some columns."""
        parts = []
        for k, file in enumerate(self._files):
            here = places[(places >= self._offsets[k]) & (places < self._offsets[k + 1])]

            def piece(
                kept: Kept, columns: Collection[str], rows: Ints = here - self._offsets[k]
            ) -> dict[str, NDArray[Any]]:
                return kept.at(rows, columns)

            parts.append(file.rows(names, piece, here, self._numbering))
        return joined(parts)

    def missing(self, name: str) -> ImportTableError:
        """Return the error that says which column a table lacks."""
        return missing_column(self._files[0].table, self.column_map, name)

    def path_of(self, origin: int) -> Path:
        """Return the file that a row is from."""
        return self.paths[int(np.searchsorted(self._offsets, origin, side="right")) - 1]

    def too_long(self) -> int:
        """Return how many rows have more cells than the header."""
        return sum(len(file.table.rejected()) for file in self._files)

    def fault(self, reason: Reason, origin: int) -> Fault:
        """Return one row that cannot be used as a fault, with its line as if none were too long."""
        k = int(np.searchsorted(self._offsets, origin, side="right")) - 1
        place = np.array([origin - self._offsets[k]])
        lines = self._files[k].table.lines(place, rejected=False)
        return next(faults_of(self._files[k], reason, place, lines))[0]

    def faults(self, unusable: Unusable) -> Iterator[list[Fault]]:
        """Yield rows that cannot be used as faults with file, line, column and cell; those with too many cells, too."""
        for k, file in enumerate(self._files):
            first, last = self._offsets[k], self._offsets[k + 1]
            here = [(reason, rows[(rows >= first) & (rows < last)] - first) for reason, rows in unusable.reasons()]
            places = np.concatenate([np.empty(0, np.int64), *(rows for _, rows in here)])
            lines = file.table.lines(places) if len(places) else places
            for reason, rows in here:
                yield from faults_of(file, reason, rows, lines[: len(rows)])
                lines = lines[len(rows) :]
            yield from too_long(file)

    def _check_alike(self) -> None:
        first = self._files[0]
        for file in self._files[1:]:
            if set(file.headers) != set(first.headers) or set(file.words) != set(first.words):
                raise ImportTableError(
                    f"{file.table.path}: has other columns than {first.table.path}, so they are not one table"
                )
        if not sum(file.kept.count for file in self._files):
            raise ImportTableError(f"{first.table.path}: a header and no rows")

    def _numbered(self) -> Numbering:
        words: dict[str, set[str]] = {n: {v} for n, v in self.column_map.constants.items() if isinstance(v, str)}
        for name in self._files[0].words:
            words[name] = set().union(*(self._distinct(file.words[name], "r") for file in self._files))
        told = (*self._files[0].headers, *self.column_map.constants)
        plain: list[str] = [name for name in IDS if name in told and name not in words]
        others = {name: self._distinct_numbers(name) for name in plain} if words else {}
        return numbering(self.paths[0], self.column_map.ids, words, others)

    def _distinct(self, kept: Kept, column: str) -> set[str]:
        ((count,),) = kept.ask(f"approx_count_distinct({column})")
        if int(count) > MOST_WORDS:
            raise too_many(self.paths[0])
        found = [str(word) for (word,) in kept.ask(f"DISTINCT {column}")]
        return set(np.array(found, dtype=np.str_).tolist())

    def _distinct_numbers(self, name: str) -> set[str]:
        if name in self.column_map.constants:
            value = np.array([self.column_map.constants[name]], dtype=np.float64)
            return {str(int(number)) for number in value[is_id(value)].tolist()}
        return set().union(*(file.whole_ids(name) for file in self._files))
