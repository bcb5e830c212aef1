"""Columns of strangers' files, put aside once they are parsed: however long they are, little of them is in memory.

They lie in a database of the process that keeps `STAGED_MB` of them in memory, and the rest in a folder for temporary
files (`TMPDIR`) that vanishes with it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile, gettempdir
from typing import TYPE_CHECKING, Any, BinaryIO, Final, Self

import numpy as np
from numpy.typing import NDArray

from uwblink.arrays import Ints
from uwblink.database import connect
from uwblink.errors import ImportTableError, first_line
from uwblink.output import is_utf8

if TYPE_CHECKING:
    import duckdb

STAGED_MB: Final = 250
"""Of what is put aside so much is kept in memory."""


def confined(paths: Sequence[Path], folder: str | None = None) -> duckdb.DuckDBPyConnection:
    """Return a connection that can open these files and no others, and whose settings are locked.

    With a `folder` it keeps no more than `STAGED_MB` in memory, and the rest there.
    """
    for path in paths:
        if not is_utf8(path):
            raise ImportTableError(f"{path}: its name and those of its folders must be UTF-8; rename it")
    return connect(paths=paths, temporary=folder, memory_mb=None if folder is None else STAGED_MB)


class Stage:
    """Where columns are put aside. Close it, or use it as a context manager."""

    def __init__(self, paths: Sequence[Path]) -> None:
        """Make room for what is in some files."""
        self._folder = TemporaryDirectory(prefix="uwblink-")
        self.db = confined(paths, self._folder.name)
        self._made = 0
        self._files: list[BinaryIO] = []

    def __enter__(self) -> Self:
        """Return the stage itself."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Forget everything."""
        self.close()

    def close(self) -> None:
        """Forget everything."""
        self.db.close()
        for file in self._files:
            file.close()
        self._folder.cleanup()

    def keep(self, query: str, bound: Sequence[Any], columns: Iterable[str]) -> Kept:
        """Put the result of a query aside, in its order; `columns` are what its columns are called.

        Raises what DuckDB raises.
        """
        self._made += 1
        table = f"kept{self._made}"
        self.db.execute(f"CREATE TABLE {table} AS {query}", list(bound))
        ((count,),) = self.db.execute(f"SELECT count(*) FROM {table}").fetchall()  # noqa: S608 - a name of ours
        return Kept(self, table, tuple(columns), int(count))

    def add(self, kept: Kept, columns: Mapping[str, NDArray[Any]]) -> None:
        """Append rows to what was put aside."""
        self.db.register("more", dict(columns))
        self.db.execute(f"INSERT INTO {kept.table} SELECT {', '.join(kept.columns)} FROM more")  # noqa: S608 - names of ours
        self.db.unregister("more")

    def file(self) -> BinaryIO:
        """Return a file for what is put aside beside the database; it vanishes when it is closed."""
        file = TemporaryFile(dir=self._folder.name)  # noqa: SIM115 - `close` closes it
        self._files.append(file)
        return file

    def unwritable(self, error: Exception) -> ImportTableError:
        """Return the error for a disk that does not take what is put aside."""
        return ImportTableError(
            f"{gettempdir()}: what does not fit into memory cannot be put there ({first_line(error)}); "
            "TMPDIR names another folder"
        )


@dataclass(frozen=True, slots=True)
class Kept:
    """Columns that were put aside, by names of ours; `count` rows, of which the first is 0."""

    stage: Stage
    table: str
    columns: tuple[str, ...]
    count: int

    def between(self, start: int, stop: int, columns: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Return columns of the rows from `start` until before `stop`, masked where there is nothing."""
        # Rows come in their order without being asked to, which would sort them.
        return self._read(columns, f"WHERE rowid >= {int(start)} AND rowid < {int(stop)}")

    def at(self, rows: Ints, columns: Iterable[str]) -> dict[str, NDArray[Any]]:
        """Return columns of some rows, in ascending order without repetition."""
        self.stage.db.register("chosen", {"chosen": np.asarray(rows, dtype=np.int64)})
        found = self._read(columns, "WHERE rowid IN (SELECT chosen FROM chosen) ORDER BY rowid")
        self.stage.db.unregister("chosen")
        return found

    def ask(self, query: str) -> list[tuple[Any, ...]]:
        """Return the rows of what follows SELECT, FROM these columns."""
        return self.stage.db.execute(f"SELECT {query} FROM {self.table}").fetchall()  # noqa: S608 - of ours

    def _read(self, columns: Iterable[str], where: str) -> dict[str, NDArray[Any]]:
        wanted = list(columns)
        if not wanted:
            return {}
        query = f"SELECT {', '.join(wanted)} FROM {self.table} {where}"  # noqa: S608 - names of ours
        return dict(self.stage.db.execute(query).fetchnumpy())
