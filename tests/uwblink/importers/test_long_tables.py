"""A table comes in as a whole or a few rows at a time, and what is in memory does not grow with it."""

import json
import random
import tracemalloc

import numpy as np
import pytest

import uwblink
from tests.uwblink.importers.test_table_forms import flights, repeated, wrapped, write
from uwblink.errors import ImportTableError
from uwblink.importers import exchange_tables, import_file, read_table, staging, usable_rows

SPOILT = ("", "nan", "x", "-1", "7.5", "99999999999999999999")


def spoilt(share, **more):
    """Rows of which some hold what cannot be used, and positions of antennas of which one moves."""
    chance = random.Random(3)
    rows = [row | {"from_x_m": k % 5, "from_y_m": 1, "from_z_m": 0, "to_x_m": 3} for k, row in enumerate(flights())]
    rows = [dict(row) | {"to_y_m": 0, "to_z_m": 2, "rxp1": -80.5, **more} for row in wrapped(rows)]
    for row in rows:
        if chance.random() < share:
            row[chance.choice(list(row))] = chance.choice(SPOILT)
    return rows


def told(contents):
    columns = [contents.exchanges.to_dict(), contents.poses.to_dict(), contents.powers]
    listed = [{name: np.asarray(column).tolist() for name, column in part.items()} for part in columns]
    return json.dumps([listed, contents.meta, list(map(str, contents.tags + contents.faults))], default=str)


def few_at_once(monkeypatch):
    for room in (staging, exchange_tables):
        monkeypatch.setattr(room, "ROWS_AT_ONCE", 20)
    monkeypatch.setattr(usable_rows, "FAULTS_AT_ONCE", 5)


@pytest.mark.parametrize("more", [{}, {"from_id": "a tag"}], ids=["numbers", "words"])
def test_a_table_is_the_same_a_few_rows_at_a_time(tmp_path, monkeypatch, more):
    table = write(tmp_path / "t.csv", spoilt(0.2, **more))
    whole = read_table(table)
    few_at_once(monkeypatch)
    assert told(read_table(table)) == told(whole)
    done = import_file(table, tmp_path / "t.uwb")
    assert done.counts == whole.counts()
    assert done.notes == whole.meta["notes"]
    written = uwblink.load(tmp_path / "t.uwb")
    assert written.faults == sorted(whole.faults, key=lambda fault: fault.time_ns)
    assert len(written.poses) == len(whole.poses) > len(whole.exchanges) / 2
    np.testing.assert_array_equal(written.exchanges.rx3, whole.exchanges.rx3)


def test_a_table_that_is_half_useless_is_refused_alike_and_leaves_nothing(tmp_path, monkeypatch):
    table = write(tmp_path / "t.csv", [row | {"rx2": "" if k % 2 else row["rx2"]} for k, row in enumerate(spoilt(0))])
    with pytest.raises(ImportTableError) as whole:
        read_table(table)
    few_at_once(monkeypatch)
    with pytest.raises(ImportTableError) as few:
        import_file(table, tmp_path / "t.uwb")
    assert str(few.value) == str(whole.value)
    assert [path.name for path in tmp_path.iterdir()] == ["t.csv"]


def test_memory_does_not_grow_with_the_table(tmp_path, monkeypatch):
    monkeypatch.setattr(staging, "ROWS_AT_ONCE", 1_000)
    peaks = []
    for times in (20, 150, 600):  # the first is for what is only made once
        table = write(tmp_path / f"{times}.csv", wrapped(repeated(flights(), times)))
        tracemalloc.start()
        import_file(table, tmp_path / f"{times}.uwb")
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # A column of 8 bytes a row that stayed would be 216 kB more.
    assert peaks[2] - peaks[1] < 150_000


def test_what_is_being_done_is_said(tmp_path):
    said = []
    import_file(
        write(tmp_path / "t.csv", wrapped(flights())), tmp_path / "t.uwb", watch=lambda *told: said.append(told)
    )
    assert [what for what, _ in said] == ["reading", "checking", "writing"]
    assert all(0 <= share <= 1 for _, share in said)


def test_times_of_the_calendar_come_from_json_lines_too(tmp_path):
    rows = [row | {"time_s": f"2024-05-06T07:08:{k % 60:02d}+02:00"} for k, row in enumerate(wrapped(flights()))]
    (tmp_path / "t.jsonl").write_text("\n".join(map(json.dumps, rows)))
    found = read_table(tmp_path / "t.jsonl")
    assert found.exchanges.time_ns[1] - found.exchanges.time_ns[0] == 1_000_000_000
