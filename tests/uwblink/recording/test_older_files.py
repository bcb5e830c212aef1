"""Files that are older than some of the tables."""

import duckdb
import numpy as np
import pytest

from uwblink.errors import RecordingError
from uwblink.recording.file import Recording
from uwblink.recording.schema import TABLES, Tag

LATER = ("imu", "height", "powers", "quality", "temperature", "receptions", "differences", "corrected")


@pytest.fixture
def older(tmp_path):
    path = tmp_path / "older.uwb"
    with Recording.create(path) as recording:
        recording.append_tags([Tag(1, "drone", (0.0, 0.0, 0.0))])
    with duckdb.connect(str(path)) as db:
        for table in LATER:
            db.execute(f"DROP TABLE {table}")
    return path


def test_tables_that_came_later_are_empty(older):
    with Recording.open(older) as recording:
        for table in LATER:
            assert recording.count(table) == 0
            assert {name: len(column) for name, column in recording.columns(table).items()} == dict.fromkeys(
                TABLES[table], 0
            )
            assert recording.show().counts[table] == 0


def test_an_older_file_is_copied_and_added_to(older, tmp_path):
    with Recording.open(older) as recording:
        recording.copy(tmp_path / "copy.uwb")
    height = {"time_ns": np.array([5]), "body": np.array(["drone"]), "height_m": np.array([0.25])}
    with Recording.open(older, update=True) as recording:
        recording.append("height", height)
    for path, count in ((older, 1), (tmp_path / "copy.uwb", 0)):
        with Recording.open(path) as recording:
            assert recording.tags()[0].body == "drone"
            assert recording.count("height") == count


def test_a_table_that_was_always_there_is_missed(older):
    with duckdb.connect(str(older)) as db:
        db.execute("DROP TABLE poses")
    with pytest.raises(RecordingError, match="table poses lacks"):
        Recording.open(older)


@pytest.mark.parametrize("table", LATER)
def test_a_table_that_came_later_came_whole(tmp_path, table):
    path = tmp_path / "f.uwb"
    with Recording.create(path):
        pass
    column = list(TABLES[table])[-1]
    with duckdb.connect(str(path)) as db:
        db.execute(f"ALTER TABLE {table} DROP COLUMN {column}")
    with pytest.raises(RecordingError, match=f"table {table} lacks {column}"):
        Recording.open(path)
