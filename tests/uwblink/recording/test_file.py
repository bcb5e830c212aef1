"""The recording: data are read as written, also meanwhile, and other files are refused."""

import json
import os
import shutil
import subprocess
import sys
import threading
from dataclasses import replace

import duckdb
import numpy as np
import pytest

from tests import processes
from tests.boards import After, record_bench
from tests.errors import one_line
from uwblink import Contents, Exchanges, Poses, RangingPlan, Recording, Tag, errors, load
from uwblink.exporters import export_recording
from uwblink.recording import store
from uwblink.recording.schema import TABLES, CirRow, Fault
from uwblink.twr import COLUMNS


def random_exchanges(n=50, seed=1):
    rng = np.random.default_rng(seed)
    columns = {name: rng.integers(0, 2**32, n) for name in COLUMNS}
    columns |= {name: rng.normal(size=n) for name in COLUMNS if name.endswith(("_m", "_dbm", "_ppm"))}
    columns |= {name: rng.integers(0, 65536, n) for name in ("initiator", "target", "reporter")}
    columns["protocol"] = rng.choice(["ss", "ds", "ds-alt"], n)
    columns["truth_m"][::2] = np.nan
    return Exchanges(**columns)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("written") / "flight.uwb"
    with Recording.create(path, meta={"seed": 7}) as r:
        r.append("exchanges", random_exchanges())
        r.append("tags", [Tag(3, "b", (0.1, 0.2, 0.3)), Tag(1, "a", (0, 0, 0))])
        r.append("poses", Poses(np.array([5, 6]), np.array(["a", "b"]), np.ones((2, 3)), np.zeros((2, 4))))
        r.append("faults", [Fault(9, "1", "time-out", "no answer")])
    return path


@pytest.fixture
def recording(written, tmp_path):
    return shutil.copyfile(written, tmp_path / "flight.uwb")


def change(path, *statements):
    with duckdb.connect(str(path)) as db:
        db.execute(";".join(statements))


LATER = ("imu", "height", "powers", "quality", "temperature", "receptions", "differences", "corrected")
"""Tables that files of earlier versions lack."""


def test_an_existing_file_is_not_replaced_without_force(recording, tmp_path):
    with pytest.raises(errors.RecordingMissingError, match="no such recording"):
        Recording.open(tmp_path / "no.uwb")
    before = recording.read_bytes()
    with pytest.raises(errors.RecordingExistsError, match="or replace it with `force`"):
        Recording.create(recording)
    assert recording.read_bytes() == before
    Contents(exchanges=random_exchanges(0)).save(recording, force=True)
    assert len(load(recording).exchanges) == 0


def test_a_failed_block_leaves_no_file(tmp_path):
    with pytest.raises(RuntimeError, match="midway"), Recording.create(tmp_path / "x.uwb") as r:
        r.append("exchanges", random_exchanges())
        raise RuntimeError("midway")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("share", [0.001, 0.3, 0.6, 0.9, 0.99])
def test_a_truncated_recording_is_one_clear_error(recording, tmp_path, share):
    content = recording.read_bytes()
    (tmp_path / "cut.uwb").write_bytes(content[: int(len(content) * share)])
    with pytest.raises(errors.RecordingError, match=r"cut\.uwb"):
        load(tmp_path / "cut.uwb")


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("UPDATE meta SET value = '99' WHERE key = 'format_version'", "version 99 is newer"),
        ("ALTER TABLE exchanges DROP COLUMN rx3", "exchanges lacks rx3"),
        ("DROP TABLE poses", "table poses lacks"),
        *(
            (f"ALTER TABLE {table} DROP COLUMN {column}", f"table {table} lacks {column}")
            for table in LATER
            for column in list(TABLES[table])[-1:]
        ),
    ],
)
def test_wrong_tables_and_newer_versions(recording, statement, said):
    """Tables of `LATER` may be missing, but not some of their columns."""
    change(recording, statement)
    with pytest.raises(errors.RecordingError, match=said):
        Recording.open(recording)


def test_a_recording_from_before_faults_named_their_exchange_is_read(recording, tmp_path):
    change(recording, "ALTER TABLE faults DROP COLUMN initiator", "ALTER TABLE faults DROP COLUMN target")
    first, later = Fault(9, "1", "time-out", "no answer", None, None), Fault(10, "1", "time-out", "no answer", 1, 2)
    with Recording.open(recording) as r:
        assert r.faults() == [first]
        with r.copying(tmp_path / "copy.uwb"):
            pass
    with Recording.open(recording, update=True) as r:
        r.append("faults", [later])
    assert [load(path).faults for path in (tmp_path / "copy.uwb", recording)] == [[first], [first, later]]


HOLDER = """
import sys, duckdb
db = duckdb.connect(sys.argv[1], read_only=sys.argv[2] == "read")
print("open", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("held", ["write", "read"])
def test_files_in_use_are_named(recording, held):
    words = [sys.executable, "-c", HOLDER, str(recording), held]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "open\n"
        with pytest.raises(errors.RecordingError, match="another process has it open"):
            Recording.open(recording, update=True)
        process.stdin.close()
        process.wait()
    with Recording.open(recording, update=True) as r:
        assert r.count("exchanges") == 50


SIZE = 3 * 4096 + 16384
"""Of a database."""


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("blocks.uwb", bytes(SIZE), r"not a \.uwb recording, or a truncated one"),  # though its path has the word lock
        *(
            (name, b"a" * size, f"{name}: is not a recording; convert it with `uwblink import {command}`")
            for name, command in (("t.csv", "csv"), ("t.csv.gz", "csv"), ("t.MCAP", "bag"))
            for size in (100, SIZE)
        ),
    ],
)
def test_damaged_files_are_called_damaged_and_errors_for_tables_name_the_import(tmp_path, name, content, said):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(errors.RecordingError, match=said):
        Recording.open(tmp_path / name)


def test_recordings_that_are_being_written_are_named(tmp_path):
    with (
        Recording.create(tmp_path / "live.uwb", live=True),
        pytest.raises(errors.RecordingError, match="open in this program"),
    ):
        Recording.open(tmp_path / "live.uwb")


@pytest.mark.parametrize(
    ("write", "expected"),
    [
        (
            lambda r: r.append("exchanges", replace(random_exchanges(), initiator=np.full(50, 70_000))),
            "table exchanges: values that do not fit",
        ),
        (
            lambda r: r.append("exchanges", replace(random_exchanges(), tx1=np.full(50, "early"))),
            "table exchanges: values that do not fit",
        ),
        (
            lambda r: r.append("exchanges", replace(random_exchanges(), range_m=np.ones(3))),
            "table exchanges: columns of different lengths",
        ),
        (lambda r: r.append("tags", [Tag(-1, "a", (0, 0, 0))]), "table tags: values that do not fit"),
        (lambda r: r.append("cirs", [CirRow(1, 1, 1, 2, 0.0, (70_000,))]), "table cirs: values that do not fit"),
        (lambda r: r.append_meta({"bad": float("nan")}), "meta 'bad': cannot be stored as JSON"),
        (lambda r: r.append_meta({"bad": {1, 2}}), "meta 'bad': cannot be stored as JSON"),
    ],
)
def test_values_that_do_not_fit_undo_their_transaction(tmp_path, write, expected):
    with Recording.create(tmp_path / "f.uwb", live=True) as r:
        r.append("exchanges", random_exchanges(7))
        with pytest.raises(errors.RecordingError, match=one_line(expected)), r.transaction():
            r.append("exchanges", random_exchanges(5))
            write(r)
        assert r.count("exchanges") == 7
        r.append("exchanges", random_exchanges(2))
    assert len(load(tmp_path / "f.uwb").exchanges) == 9


@pytest.fixture
def older(recording):
    change(recording, *(f"DROP TABLE {table}" for table in LATER))
    return recording


def test_tables_that_came_later_are_empty(older):
    with Recording.open(older) as opened:
        for table in LATER:
            assert opened.count(table) == opened.show().counts[table] == 0
            lengths = {name: len(column) for name, column in opened.columns(table).items()}
            assert lengths == dict.fromkeys(TABLES[table], 0)


def test_an_older_file_is_copied_and_added_to(older, tmp_path):
    with Recording.open(older) as recording, recording.copying(tmp_path / "copy.uwb"):
        pass
    height = {"time_ns": np.array([5]), "body": np.array(["drone"]), "height_m": np.array([0.25])}
    with Recording.open(older, update=True) as recording:
        recording.append("height", height)
    for path, count in ((older, 1), (tmp_path / "copy.uwb", 0)):
        found = load(path)
        assert (found.tags[0].body, found.counts().get("height", 0)) == ("a", count)


# A recording is read by other processes while it is written: they get all committed rows, and leave no files.


WRITE = """
import sys, time, uwblink
from uwblink.recording.schema import Fault
with uwblink.Recording.create(sys.argv[1], live=True) as recording:
    for k in range(50):
        recording.append("faults", [Fault(k, "1", "kind", f"row {k}")])
    print("writing", flush=True)
    time.sleep(60)
"""


def test_another_process_reads_what_is_recorded_so_far(tmp_path):
    """The writer commits every 0.1 s, and later under load."""
    path = tmp_path / "f's.uwb"

    def committed():
        return json.loads(processes.fork("uwblink", "show", "--json", path).stdout)["counts"]["exchanges"]

    reader = After(t100=lambda: processes.wait_until(lambda: committed() == 100))
    record_bench(path, RangingPlan(rate_hz=100.0), duration_s=2.0, listeners=[reader])
    assert [p.name for p in tmp_path.iterdir()] == [path.name], "no copy, no log is left"
    assert len(load(path).exchanges) > 100


@pytest.fixture
def writer(tmp_path):
    """Another process that has committed fifty faults, and keeps the recording open."""
    words = [sys.executable, "-c", WRITE, str(tmp_path / "f.uwb")]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.stdout.readline()
        yield tmp_path / "f.uwb"
        process.kill()


def test_what_any_writer_has_committed_is_read_and_not_updated(writer):
    with Recording.open(writer) as recording:
        assert [fault.detail for fault in recording.faults()] == [f"row {k}" for k in range(50)]
        assert recording.path == writer
    with pytest.raises(errors.RecordingInUseError, match="has it open; wait"):
        Recording.open(writer, update=True)
    assert sorted(p.name for p in writer.parent.iterdir()) == ["f.uwb", "f.uwb.wal"]


def test_copied_logs_are_read_up_to_the_last_complete_commit(writer, tmp_path):
    copy, log = tmp_path / "copy.uwb", (tmp_path / "f.uwb.wal").read_bytes()
    copy.write_bytes(writer.read_bytes())
    for share in (0.0, 0.1, 0.5, 0.77, 0.999):
        (tmp_path / "copy.uwb.wal").write_bytes(log[: int(share * len(log))])
        with Recording.open(copy) as recording:
            found = [fault.detail for fault in recording.faults()]
        assert found == [f"row {k}" for k in range(len(found))]
        assert abs(len(found) - share * 50) < 10


@pytest.mark.parametrize("changing", [True, False])
def test_failed_copies_are_errors_of_the_reader_only(writer, monkeypatch, changing):
    def copy(source, _target):
        if not changing:
            raise OSError(28, "No space left on device")
        os.utime(source)

    monkeypatch.setattr("shutil.copyfile", copy)
    why = "changes faster than it can be copied" if changing else r"cannot be copied \(No space left on device\)"
    with pytest.raises(
        errors.RecordingInUseError, match=f"another process is writing it, and it {why}; wait until that"
    ):
        Recording.open(writer)
    assert sorted(p.name for p in writer.parent.iterdir()) == ["f.uwb", "f.uwb.wal"]


# Untrusted files: programs in them are refused before they run, and too large contents before they are read.


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
def test_programs_in_a_file_are_refused_in_one_line(recording, statements, named):
    """Files are opened for reading, and those with two statements for updating."""
    change(recording, *statements)
    with pytest.raises(errors.RecordingError, match=one_line("flight.uwb", named)):
        Recording.open(recording, update=len(statements) == 2)


def test_a_trigger_in_a_file_is_refused(recording, tmp_path):
    with duckdb.connect() as db:
        if not db.execute("SELECT 1 FROM duckdb_functions() WHERE function_name = 'duckdb_triggers'").fetchall():
            pytest.skip(f"DuckDB {duckdb.__version__} has no triggers")
        db.execute(f"ATTACH '{recording}' AS plain (READ_ONLY)")
        db.execute(f"ATTACH '{tmp_path / 'stranger2.uwb'}' AS stranger (STORAGE_VERSION 'v2.0.0')")
        db.execute("COPY FROM DATABASE plain TO stranger")
        db.execute("USE stranger")
        db.execute("CREATE TRIGGER t AFTER INSERT ON poses FOR EACH STATEMENT DELETE FROM tags")
    with pytest.raises(errors.RecordingError, match=r"stranger2\.uwb: contains a trigger, t;"):
        Recording.open(tmp_path / "stranger2.uwb", update=True)


def test_recordings_may_have_names_of_databases(recording, tmp_path):
    for name in ("system", "information_schema", "main", 'a"b;--'):
        place = tmp_path / f"{name}.uwb"
        place.write_bytes(recording.read_bytes())
        with Recording.open(place) as opened:
            assert len(opened.tags()) == 2


def test_an_export_looks_the_file_over_too(recording, tmp_path):
    change(recording, "DROP TABLE poses", "CREATE VIEW poses AS SELECT 1 AS time_ns")
    with pytest.raises(errors.RecordingError, match="a view, poses"):
        export_recording(recording, tmp_path / "out", to="csv")
    assert not (tmp_path / "out").exists()


def test_settings_cannot_be_changed_on_any_connection(recording, tmp_path):
    with Recording.create(tmp_path / "new.uwb") as written, Recording.open(recording) as opened:
        for one in (written, opened):
            for setting in ("enable_external_access = true", "memory_limit = '1MB'"):
                with pytest.raises(duckdb.InvalidInputException, match="locked"):
                    one._execute(f"SET {setting}")


def test_writers_use_only_the_folder_of_the_recording(tmp_path):
    (tmp_path / "here").mkdir()
    with (
        Recording.create(tmp_path / "here" / "new.uwb", live=True) as recording,
        pytest.raises(errors.RecordingError, match=r"new.uwb: cannot be written any more .*disabled"),
    ):
        recording._execute(f"ATTACH '{tmp_path / 'elsewhere.uwb'}' AS elsewhere")
    assert not (tmp_path / "elsewhere.uwb").exists()


def test_more_rows_than_a_file_can_hold_are_not_read(recording, monkeypatch):
    change(recording, "INSERT INTO height SELECT 0, 'drone', 1.0 FROM range(3000000)")
    assert recording.stat().st_size < 3_000_000, "three million rows that are all alike take less than a byte each"
    with Recording.open(recording) as opened:
        assert opened.count("height") == 3_000_000
    monkeypatch.setattr(store, "ROWS_OF_ANY_FILE", 1_000_000)
    with pytest.raises(errors.RecordingError, match="table height holds 3000000 rows"):
        Recording.open(recording)


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
def test_wrong_json_and_too_many_bytes_in_meta_are_refused(recording, value, expected):
    change(recording, f"INSERT INTO meta VALUES ('x', {value})")
    with pytest.raises(errors.RecordingError, match=expected) as caught:
        Recording.open(recording)
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
def test_missing_values_wrong_orders_and_widths_of_stamps_are_refused_when_they_are_read(
    recording, table, statement, said
):
    change(recording, statement)
    with Recording.open(recording) as opened, pytest.raises(errors.RecordingError, match=said):
        getattr(opened, table)()


def test_endless_reads_are_interrupted(recording):
    opened = Recording.open(recording)
    opened._longest_read_s = 0.3
    with pytest.raises(errors.RecordingError, match="took longer than 0 s"):
        opened._select("SELECT sum(a.range * b.range) FROM range(10000000) a, range(10000000) b")
    opened._longest_read_s = 60.0
    assert opened._select("SELECT 1 AS one")["one"].tolist() == [1]
    opened.__exit__(None, None, None)
    assert not [t for t in threading.enumerate() if isinstance(t, threading.Timer) and not t.finished.is_set()]
