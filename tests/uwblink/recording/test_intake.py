"""Untrusted files: programs in them are refused before they run, and too large contents before they are read."""

import json
import shutil
import threading

import duckdb
import pytest

from tests.errors import one_line
from tests.uwblink.recording.test_file import change, random_exchanges
from uwblink import Contents, Recording, Tag, errors
from uwblink.exporters import export_recording
from uwblink.recording import store


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    path = tmp_path_factory.mktemp("saved") / "stranger.uwb"
    Contents(exchanges=random_exchanges(0), tags=[Tag(1, "drone", (0.0, 0.0, 0.0))]).save(path)
    return path


@pytest.fixture
def file(saved, tmp_path):
    return shutil.copyfile(saved, tmp_path / "stranger.uwb")


HUGE = "SELECT 'k' AS key, 'v' AS value FROM range(10000000000)"
ENDLESS = (
    "WITH RECURSIVE turns(key, value) AS (SELECT 'k', '1' UNION ALL SELECT key, value FROM turns) SELECT * FROM turns"
)


@pytest.mark.parametrize(
    ("statements", "named"),
    [
        (["DROP TABLE meta", f"CREATE VIEW meta AS {HUGE}"], "a view, meta"),
        (["DROP TABLE meta", f"CREATE VIEW meta AS {ENDLESS}"], "a view, meta"),
        (["DROP TABLE poses", "CREATE VIEW poses AS SELECT * FROM exchanges, range(1000000)"], "a view, poses"),
        # Objects that would replace functions of the database, and give false results.
        (
            ["CREATE MACRO duckdb_views() AS TABLE SELECT 1 WHERE false", "CREATE VIEW a AS SELECT 1"],
            "a macro, duckdb_views",
        ),
        (["CREATE MACRO duckdb_functions() AS TABLE SELECT 1 WHERE false"], "a macro, duckdb_functions"),
        (["CREATE MACRO count(a) AS 17"], "a macro, count"),
        (["CREATE MACRO list_position(a, b) AS 1"], "a macro, list_position"),
        (["CREATE SCHEMA system"], "a schema, system"),
        (["CREATE SCHEMA other", "CREATE TABLE other.meta(key TEXT)"], "a schema, other"),
        (["CREATE TYPE mood AS ENUM ('good')"], "a type, mood"),
        (["CREATE SEQUENCE s"], "a sequence, s"),
        (
            ["DROP TABLE poses", "CREATE TABLE poses(x DOUBLE CHECK (len(range(x::BIGINT * 100000000000)) > 0))"],
            "a constraint, CHECK",
        ),
        (["CREATE INDEX i ON poses((sin(x)))"], "an index, i"),
        (["ALTER TABLE tags ADD COLUMN w BIGINT DEFAULT 5"], "a computed column or a default, tags.w"),
        (
            [
                "DROP TABLE height",
                "CREATE TABLE height(time_ns BIGINT, body TEXT, height_m DOUBLE AS (random()) VIRTUAL)",
            ],
            "a computed column or a default, height.height_m",
        ),
        (["ALTER TABLE tags ALTER tag TYPE VARCHAR"], "column tag is VARCHAR, expected USMALLINT"),
        (["ALTER TABLE meta ALTER value TYPE STRUCT(a VARCHAR) USING {'a': value}"], "column value is STRUCT"),
        (['CREATE VIEW "a\nb" AS SELECT 1'], "a view, a\N{REPLACEMENT CHARACTER}b"),
    ],
)
def test_programs_in_a_file_are_refused_in_one_line(file, statements, named):
    """Files are opened for reading, and those with two statements for updating."""
    change(file, *statements)
    with pytest.raises(errors.RecordingError, match=one_line("stranger.uwb", named)):
        Recording.open(file, update=len(statements) == 2)


def test_a_trigger_in_a_file_is_refused(file, tmp_path):
    with duckdb.connect() as db:
        if not db.execute("SELECT 1 FROM duckdb_functions() WHERE function_name = 'duckdb_triggers'").fetchall():
            pytest.skip(f"DuckDB {duckdb.__version__} has no triggers")
        db.execute(f"ATTACH '{file}' AS plain (READ_ONLY)")
        db.execute(f"ATTACH '{tmp_path / 'stranger2.uwb'}' AS stranger (STORAGE_VERSION 'v2.0.0')")
        db.execute("COPY FROM DATABASE plain TO stranger")
        db.execute("USE stranger")
        db.execute("CREATE TRIGGER t AFTER INSERT ON poses FOR EACH STATEMENT DELETE FROM tags")
    with pytest.raises(errors.RecordingError, match=r"stranger2\.uwb: contains a trigger, t;"):
        Recording.open(tmp_path / "stranger2.uwb", update=True)


def test_recordings_may_have_names_of_databases(file, tmp_path):
    for name in ("system", "information_schema", "main", 'a"b;--'):
        place = tmp_path / f"{name}.uwb"
        place.write_bytes(file.read_bytes())
        with Recording.open(place) as recording:
            assert len(recording.tags()) == 1


def test_an_export_looks_the_file_over_too(file, tmp_path):
    change(file, "DROP TABLE poses", "CREATE VIEW poses AS SELECT 1 AS time_ns")
    with pytest.raises(errors.RecordingError, match="a view, poses"):
        export_recording(file, tmp_path / "out", to="csv")
    assert not (tmp_path / "out").exists()


def test_settings_cannot_be_changed_on_any_connection(file, tmp_path):
    with Recording.create(tmp_path / "new.uwb") as written, Recording.open(file) as opened:
        for recording in (written, opened):
            for setting in ("enable_external_access = true", "memory_limit = '1MB'"):
                with pytest.raises(duckdb.InvalidInputException, match="locked"):
                    recording._execute(f"SET {setting}")


def test_writers_use_only_the_folder_of_the_recording(tmp_path):
    (tmp_path / "here").mkdir()
    with (
        Recording.create(tmp_path / "here" / "new.uwb", live=True) as recording,
        pytest.raises(errors.RecordingError, match=r"new.uwb: cannot be written any more .*disabled"),
    ):
        recording._execute(f"ATTACH '{tmp_path / 'elsewhere.uwb'}' AS elsewhere")
    assert not (tmp_path / "elsewhere.uwb").exists()


def test_more_rows_than_a_file_can_hold_are_not_read(file, monkeypatch):
    change(file, "INSERT INTO height SELECT 0, 'drone', 1.0 FROM range(3000000)")
    assert file.stat().st_size < 2_000_000, "three million rows that are all alike take no place"
    with Recording.open(file) as recording:
        assert recording.count("height") == 3_000_000
    monkeypatch.setattr(store, "ROWS_OF_ANY_FILE", 2_000_000)
    with pytest.raises(errors.RecordingError, match="table height holds 3000000 rows"):
        Recording.open(file)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("NULL", "table meta: x has no value"),
        ("'NaN'", "that of x"),
        ("'[1, -Infinity]'", "that of x"),
        ("'[1, -1e400]'", "that of x"),
        (f"'{'[' * 100_000}'", "that of x"),
        ("'{'", "that of x"),
        (f"repeat('9', {store.MOST_META_BYTES})", r"table meta holds 64\d+ bytes, at most 64000000"),
    ],
)
def test_wrong_json_and_too_many_bytes_in_meta_are_refused(file, value, expected):
    change(file, f"INSERT INTO meta VALUES ('x', {value})")
    with pytest.raises(errors.RecordingError, match=expected) as caught:
        Recording.open(file)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize(
    ("table", "statement", "said"),
    [
        *(
            (table, f"INSERT INTO {table} VALUES ({row})", f"table {table}: a row with nothing")
            for table, row in (
                ("tags", "2, NULL, 0, 0, 0"),
                ("cirs", "9, 1, 1, 2, NULL, NULL"),
                ("faults", "9, NULL, 'power', '', NULL, 3"),
            )
        ),
        *(
            ("arrangements", f"INSERT INTO arrangements VALUES (0, 1, 'A', '{known}')", "known: found")
            for known in ("line 1 1", "plane 1 2", "line 1 b", "line  1")
        ),
        *(
            (
                "exchanges",
                f"UPDATE meta SET value = '{json.dumps(bits)}' WHERE key = 'timestamp_bits'",
                r"timestamp_bits is .*expected 32 or 40",
            )
            for bits in (0, -1, 33, 64, 10**30, True, None, "32", [32], 32.5)
        ),
    ],
)
def test_missing_values_wrong_orders_and_widths_of_stamps_are_refused_when_they_are_read(file, table, statement, said):
    change(file, statement)
    with Recording.open(file) as recording, pytest.raises(errors.RecordingError, match=said):
        getattr(recording, table)()


def test_endless_reads_are_interrupted(file):
    recording = Recording.open(file)
    recording._longest_read_s = 0.3
    with pytest.raises(errors.RecordingError, match="took longer than 0 s"):
        recording._select("SELECT sum(a.range * b.range) FROM range(10000000) a, range(10000000) b")
    recording._longest_read_s = 60.0
    assert recording._select("SELECT 1 AS one")["one"].tolist() == [1]
    recording.__exit__(None, None, None)
    assert not [t for t in threading.enumerate() if isinstance(t, threading.Timer) and not t.finished.is_set()]
