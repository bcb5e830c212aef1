"""Tables of results beside recordings: CSV and Parquet files, and a store that survives being killed."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Self

from uwblink.errors import UwblinkError

TYPES: Final = {bool: "BOOLEAN", int: "BIGINT", float: "DOUBLE", str: "VARCHAR"}
"""Of columns, by the type of their first value that is not None."""


class TableError(UwblinkError, ValueError):
    """A table or store that cannot be read or written: what, where, what to do."""


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as CSV; the columns are those of the first row."""
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]), restval="")
        writer.writeheader()
        writer.writerows(rows)


def write_parquet(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows as Parquet."""
    import duckdb

    with duckdb.connect() as db:
        _create(db, "rows", rows)
        db.table("rows").write_parquet(str(path))


def _create(db: Any, name: str, rows: Sequence[Mapping[str, Any]]) -> None:
    columns = {key: _type(key, rows) for key in rows[0]}
    declared = ", ".join(f"{_quoted(key)} {kind}" for key, kind in columns.items())
    db.execute(f"CREATE TABLE {name} ({declared})")
    places = ", ".join("?" * len(columns))
    db.executemany(f"INSERT INTO {name} VALUES ({places})", [[row.get(key) for key in columns] for row in rows])  # noqa: S608 - a name of ours


def _type(key: str, rows: Sequence[Mapping[str, Any]]) -> str:
    known = {type(row[key]) for row in rows if row.get(key) is not None}
    # Whole numbers among others are numbers; anything else mixed is text.
    if known == {int, float}:
        return "DOUBLE"
    return TYPES.get(next(iter(known)), "VARCHAR") if len(known) == 1 else "VARCHAR"


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"'


class Store:
    """Results by number, committed as they come: whoever is killed loses what was not committed, and nothing else."""

    def __init__(self, connection: Any) -> None:
        """Wrap an open database; use `create` or `open`."""
        self._db = connection

    @classmethod
    def create(cls, path: Path, identity: Mapping[str, Any]) -> Self:
        """Make a new store; `identity` says what its results are of."""
        db = _connect(path)
        db.execute("BEGIN")
        db.execute("CREATE TABLE identity (key VARCHAR, value VARCHAR)")
        db.executemany("INSERT INTO identity VALUES (?, ?)", [[k, json.dumps(v)] for k, v in identity.items()])
        db.execute("CREATE TABLE results (number BIGINT, part BIGINT, document VARCHAR)")
        db.execute("COMMIT")
        return cls(db)

    @staticmethod
    def begun(path: Path) -> bool:
        """Return whether a file is there and holds anything: a kill at the very start leaves an empty one."""
        if not path.exists():
            return False
        with _connect(path) as db:
            return bool(db.execute("SELECT 1 FROM information_schema.tables").fetchall())

    @classmethod
    def open(cls, path: Path) -> Self:
        """Open a store; raises `TableError` where the file is none."""
        db = _connect(path)
        names = {row[0] for row in db.execute("SELECT table_name FROM information_schema.tables").fetchall()}
        if not {"identity", "results"} <= names:
            db.close()
            raise TableError(f"{path}: not a store of results")
        return cls(db)

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the store."""
        self._db.close()

    def identity(self) -> dict[str, Any]:
        """Return what the store was made for."""
        return {key: json.loads(value) for key, value in self._db.execute("SELECT * FROM identity").fetchall()}

    def done(self) -> set[int]:
        """Return the numbers that have results."""
        return {int(row[0]) for row in self._db.execute("SELECT DISTINCT number FROM results").fetchall()}

    def append(self, results: Sequence[tuple[int, Sequence[Mapping[str, Any]]]]) -> None:
        """Commit results, each a number and its rows, all or none."""
        rows = [[n, k, json.dumps(row)] for n, some in results for k, row in enumerate(some)]
        self._db.execute("BEGIN")
        if rows:
            self._db.executemany("INSERT INTO results VALUES (?, ?, ?)", rows)
        self._db.execute("COMMIT")

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield all rows in the order of their numbers."""
        cursor = self._db.cursor()
        cursor.execute("SELECT document FROM results ORDER BY number, part")
        while batch := cursor.fetchmany(5000):
            for (document,) in batch:
                yield json.loads(document)


def export(store: Store, table: Path, parquet: Path) -> None:
    """Write the rows of a store as CSV and Parquet, row by row, with the columns of all of them."""
    import duckdb

    keys = list(dict.fromkeys(key for row in store.rows() for key in row))
    with table.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, keys, restval="")
        writer.writeheader()
        writer.writerows(store.rows())
    parquet.unlink(missing_ok=True)
    with duckdb.connect() as db:
        db.read_csv(str(table), header=True, sample_size=-1).write_parquet(str(parquet))


def _connect(path: Path) -> Any:
    import duckdb

    try:
        return duckdb.connect(str(path))
    except duckdb.Error as error:
        reason = str(error).splitlines()[0]
        raise TableError(f"{path}: cannot be opened ({reason[:120]})") from error
