"""Tables that are whole or not there at all; what they hold is tested by sweeps and comparisons."""

import pytest

from uwbsim.tables import write_tables

ROWS = [{"name": "a", "n": 1, "x": 0.5}, {"name": "b", "n": 2, "x": None}]


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
    table, parquet = tmp_path / "t.csv", tmp_path / "t.parquet"
    write_tables(table, parquet, ROWS, force=False)
    before = table.read_bytes(), parquet.read_bytes()
    with pytest.raises(KeyboardInterrupt):
        write_tables(table, parquet, Failing(), force=True)
    assert (table.read_bytes(), parquet.read_bytes()) == before
    assert sorted(file.name for file in tmp_path.iterdir()) == ["t.csv", "t.parquet"]
