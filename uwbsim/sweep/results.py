"""The results of a sweep: a store that survives being killed, and the tables made from it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, Final, Self

from uwblink.database import connect
from uwblink.errors import UwblinkError, first_line
from uwblink.output import is_utf8, whole
from uwblink.recording.intake import check_tables, interrupted_after, longest_read_s
from uwbsim.tables import fill_csv, fill_parquet


class TableError(UwblinkError, ValueError):
    """A table or store that cannot be read or written: what, where, what to do."""


TABLES: Final = {
    "identity": {"key": "VARCHAR", "value": "VARCHAR"},
    "results": {"number": "BIGINT", "part": "BIGINT", "document": "VARCHAR"},
}


class Store:
    """Results by number, committed as they come: a killed sweep loses what was not committed, and nothing else."""

    def __init__(self, connection: Any, path: Path) -> None:
        """Wrap an open database; use `create` or `open`."""
        self._db, self._path = connection, path

    @classmethod
    def create(cls, path: Path, identity: Mapping[str, Any]) -> Self:
        """Make a new store; `identity` says what its results are of."""
        db = _connect(path)
        with _writing(path):
            db.execute("BEGIN")
            for table, columns in TABLES.items():
                db.execute(f"CREATE TABLE {table} ({', '.join(f'{name} {kind}' for name, kind in columns.items())})")
            db.executemany("INSERT INTO identity VALUES (?, ?)", [[k, json.dumps(v)] for k, v in identity.items()])
            db.execute("COMMIT")
        return cls(db, path)

    @staticmethod
    def begun(path: Path) -> bool:
        """Return whether a file is there and holds anything: a kill at the very start leaves an empty one."""
        if not path.exists():
            return False
        with _connect(path) as db, _reading(path):
            return bool(db.execute("SELECT 1 FROM system.main.duckdb_tables() WHERE NOT internal").fetchall())

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a store from an untrusted file; raises `TableError` where it is no store, or its rows are too long."""
        db = _connect(path)
        try:
            with _reading(path), interrupted_after(longest_read_s(path.stat().st_size), db.interrupt):
                cls._check(db, path)
        except UwblinkError:
            db.close()
            raise
        return cls(db, path)

    @staticmethod
    def _check(db: Any, path: Path) -> None:
        check_tables(lambda query: db.execute(query).fetchall(), path, path.stat().st_size, TABLES)
        found = set(db.execute("SELECT table_name, column_name FROM system.main.duckdb_columns()").fetchall())
        if not {(table, column) for table, columns in TABLES.items() for column in columns} <= found:
            raise TableError(f"{path}: not a store of results")
        ((longest,),) = db.execute("SELECT coalesce(max(strlen(document)), 0) FROM results").fetchall()
        # Fifty times what a run has with a hundred figures; 5000 rows are read at a time, 0.5 GB.
        most = 100_000
        if longest > most:
            raise TableError(f"{path}: a row of {longest} letters, and results have at most {most}")

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the store."""
        self._db.close()

    def identity(self) -> dict[str, Any]:
        """Return what the store was made for."""
        with _reading(self._path):
            rows = self._db.execute("SELECT key, value FROM identity").fetchall()
            return {key: json.loads(value) for key, value in rows}

    def done(self) -> set[int]:
        """Return the numbers that have results."""
        with _reading(self._path):
            return {int(row[0]) for row in self._db.execute("SELECT DISTINCT number FROM results").fetchall()}

    def append(self, results: Sequence[tuple[int, Sequence[Mapping[str, Any]]]]) -> None:
        """Commit results, each a number and its rows, all or none; raises `TableError`."""
        rows = [(n, k, json.dumps(row)) for n, some in results for k, row in enumerate(some)]
        if not rows:
            return
        # One statement and one commit, however many rows: a statement a row took most of a sweep's own time.
        columns = [list(column) for column in zip(*rows, strict=True)]
        with _writing(self._path):
            self._db.execute("INSERT INTO results SELECT unnest(?), unnest(?), unnest(?)", columns)

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield all rows in the order of their numbers; raises `TableError` where one is damaged."""
        with _reading(self._path):
            cursor = self._db.cursor()
            cursor.execute("SELECT document FROM results ORDER BY number, part")
            while batch := cursor.fetchmany(5000):
                for (document,) in batch:
                    yield dict(json.loads(document))


def export(store: Store, table: Path, parquet: Path) -> None:
    """Write the rows of a store as CSV and Parquet, row by row, with the columns of all of them; replaces both."""
    columns = list(dict.fromkeys(key for row in store.rows() for key in row))
    with whole(table, force=True) as rows, whole(parquet, force=True) as packed:
        fill_csv(rows, columns, store.rows())
        with connect(paths=[rows, packed]) as db:
            fill_parquet(packed, db.read_csv(str(rows), header=True, sample_size=-1), parquet)


def _connect(path: Path) -> Any:
    import duckdb

    if not is_utf8(path):
        raise TableError(f"{path}: its name and those of its folders must be UTF-8; give another one")
    if path.is_symlink():
        raise TableError(f"{path}: is a link; a sweep goes on in the folder that it was begun in")
    try:
        return connect(path)
    except duckdb.Error as error:
        reason = str(error).splitlines()[0]
        if "lock" in reason:
            raise TableError(f"{path}: another sweep writes its results there; give another folder") from error
        raise TableError(f"{path}: cannot be opened ({reason[:120]})") from error


def _reading(path: Path) -> AbstractContextManager[None]:
    """Turn an error of reading into one that names the store."""
    kinds = ValueError, TypeError, KeyError, RecursionError
    return _naming(path, "its results are damaged ({}); begin in another folder", kinds)


def _writing(path: Path) -> AbstractContextManager[None]:
    """Turn an error of writing into one that names the store."""
    return _naming(path, "cannot be written ({}); is the disk full? Results so far are kept")


@contextmanager
def _naming(path: Path, text: str, kinds: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    import duckdb

    wrong: tuple[type[Exception], ...] = (duckdb.Error, *kinds)
    try:
        yield
    except UwblinkError:
        raise
    except wrong as error:
        raise TableError(f"{path}: {text.format(first_line(error))}") from error
