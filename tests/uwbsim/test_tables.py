"""Tables that are whole or not there at all."""

import csv

import duckdb
import pytest

from uwblink.errors import RecordingExistsError
from uwbsim.sweep.results import Store, export
from uwbsim.tables import write_csv, write_parquet

ROWS = [{"name": "a", "n": 1, "x": 0.5}, {"name": "b", "n": 2, "x": None}]


@pytest.mark.parametrize("write", [write_csv, write_parquet])
def test_a_table_is_not_replaced_by_accident(tmp_path, write):
    path = tmp_path / "t"
    write(path, ROWS, force=False)
    before = path.read_bytes()
    with pytest.raises(RecordingExistsError):
        write(path, ROWS[:1], force=False)
    assert path.read_bytes() == before
    write(path, ROWS[:1], force=True)
    assert path.read_bytes() != before


def test_both_forms_hold_the_rows(tmp_path):
    write_csv(tmp_path / "t.csv", ROWS, force=False)
    write_parquet(tmp_path / "t.parquet", ROWS, force=False)
    with (tmp_path / "t.csv").open(newline="") as stream:
        assert [row["x"] for row in csv.DictReader(stream)] == ["0.5", ""]
    with duckdb.connect() as db:
        assert db.read_parquet(str(tmp_path / "t.parquet")).fetchall() == [("a", 1, 0.5), ("b", 2, None)]


def test_a_table_that_fails_half_way_leaves_what_was_there(tmp_path):
    path = tmp_path / "t.csv"
    write_csv(path, ROWS, force=False)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="fields not in fieldnames"):
        write_csv(path, [*ROWS, {"stranger": 1}], force=True)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["t.csv"]


def test_the_tables_of_a_sweep_are_replaced_together_or_not_at_all(tmp_path, monkeypatch):
    table, parquet = tmp_path / "r.csv", tmp_path / "r.parquet"
    with Store.create(tmp_path / "s.duckdb", {"name": "x"}) as store:
        store.append([(0, [{"x": 1.0}])])
        export(store, table, parquet)
        before = table.read_bytes(), parquet.read_bytes()
        store.append([(1, [{"x": 2.0}])])
        monkeypatch.setattr("uwbsim.sweep.results.fill_csv", _half)
        with pytest.raises(KeyboardInterrupt):
            export(store, table, parquet)
    assert (table.read_bytes(), parquet.read_bytes()) == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["r.csv", "r.parquet", "s.duckdb"]


def _half(path, columns, rows):
    path.write_text("x\n1.0\n2.")
    raise KeyboardInterrupt
