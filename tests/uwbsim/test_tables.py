"""Tables that are whole or not there at all."""

import csv
from pathlib import Path

import duckdb
import pytest

from uwblink.errors import RecordingExistsError
from uwbsim.tables import write_csv, write_tables

ROWS = [{"name": "a", "n": 1, "x": 0.5}, {"name": "b", "n": 2, "x": None}]


def both(path) -> tuple[Path, Path]:
    return path / "t.csv", path / "t.parquet"


def test_tables_are_not_replaced_by_accident(tmp_path):
    write_tables(*both(tmp_path), ROWS, force=False)
    before = [path.read_bytes() for path in both(tmp_path)]
    with pytest.raises(RecordingExistsError):
        write_tables(*both(tmp_path), ROWS[:1], force=False)
    assert [path.read_bytes() for path in both(tmp_path)] == before
    write_tables(*both(tmp_path), ROWS[:1], force=True)
    assert all(path.read_bytes() != data for path, data in zip(both(tmp_path), before, strict=True))


def test_both_forms_hold_the_rows(tmp_path):
    table, parquet = both(tmp_path)
    write_tables(table, parquet, ROWS, force=False)
    with table.open(newline="") as stream:
        assert [row["x"] for row in csv.DictReader(stream)] == ["0.5", ""]
    with duckdb.connect() as db:
        assert db.read_parquet(str(parquet)).fetchall() == [("a", 1, 0.5), ("b", 2, None)]


class Failing:
    """Rows that can be read once, and then only in part."""

    def __init__(self):
        self.left = 3

    def __iter__(self):
        for row in ROWS:
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            yield row


def test_tables_that_fail_half_way_leave_what_was_there(tmp_path):
    table, parquet = both(tmp_path)
    write_tables(table, parquet, ROWS, force=False)
    write_csv(tmp_path / "other.csv", ROWS, force=False)
    before = table.read_bytes(), parquet.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_tables(table, parquet, Failing(), force=True)
    with pytest.raises(KeyboardInterrupt):
        write_csv(tmp_path / "other.csv", Failing(), force=True)
    assert (table.read_bytes(), parquet.read_bytes(), (tmp_path / "other.csv").read_bytes()) == (*before, before[0])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["other.csv", "t.csv", "t.parquet"]
