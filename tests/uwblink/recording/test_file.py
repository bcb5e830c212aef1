"""The recording: data are read as written, also meanwhile, and other files are refused."""

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace

import duckdb
import numpy as np
import pytest

from tests import processes
from tests.boards import After, record_bench
from tests.errors import one_line
from uwblink import Contents, Exchanges, Poses, RangingPlan, Recording, Tag, errors, load
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
        r.append_exchanges(random_exchanges())
        r.append_tags([Tag(3, "b", (0.1, 0.2, 0.3)), Tag(1, "a", (0, 0, 0))])
        r.append_poses(Poses(np.array([5, 6]), np.array(["a", "b"]), np.ones((2, 3)), np.zeros((2, 4))))
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
        r.append_exchanges(random_exchanges())
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
        r.copy(tmp_path / "copy.uwb")
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
            lambda r: r.append_exchanges(replace(random_exchanges(), initiator=np.full(50, 70_000))),
            "table exchanges: values that do not fit",
        ),
        (
            lambda r: r.append_exchanges(replace(random_exchanges(), tx1=np.full(50, "early"))),
            "table exchanges: values that do not fit",
        ),
        (
            lambda r: r.append_exchanges(replace(random_exchanges(), range_m=np.ones(3))),
            "table exchanges: columns of different lengths",
        ),
        (lambda r: r.append_tags([Tag(-1, "a", (0, 0, 0))]), "table tags: values that do not fit"),
        (lambda r: r.append("cirs", [CirRow(1, 1, 1, 2, 0.0, (70_000,))]), "table cirs: values that do not fit"),
        (lambda r: r.append_meta({"bad": float("nan")}), "meta 'bad': cannot be stored as JSON"),
        (lambda r: r.append_meta({"bad": {1, 2}}), "meta 'bad': cannot be stored as JSON"),
    ],
)
def test_values_that_do_not_fit_undo_their_transaction(tmp_path, write, expected):
    with Recording.create(tmp_path / "f.uwb", live=True) as r:
        r.append_exchanges(random_exchanges(7))
        with pytest.raises(errors.RecordingError, match=one_line(expected)), r.transaction():
            r.append_exchanges(random_exchanges(5))
            write(r)
        assert r.count("exchanges") == 7
        r.append_exchanges(random_exchanges(2))
    assert len(load(tmp_path / "f.uwb").exchanges) == 9


@pytest.fixture
def older(tmp_path):
    Contents(exchanges=random_exchanges(0), tags=[Tag(1, "drone", (0.0, 0.0, 0.0))]).save(tmp_path / "older.uwb")
    change(tmp_path / "older.uwb", *(f"DROP TABLE {table}" for table in LATER))
    return tmp_path / "older.uwb"


def test_tables_that_came_later_are_empty(older):
    with Recording.open(older) as recording:
        for table in LATER:
            assert recording.count(table) == recording.show().counts[table] == 0
            lengths = {name: len(column) for name, column in recording.columns(table).items()}
            assert lengths == dict.fromkeys(TABLES[table], 0)


def test_an_older_file_is_copied_and_added_to(older, tmp_path):
    with Recording.open(older) as recording:
        recording.copy(tmp_path / "copy.uwb")
    height = {"time_ns": np.array([5]), "body": np.array(["drone"]), "height_m": np.array([0.25])}
    with Recording.open(older, update=True) as recording:
        recording.append("height", height)
    for path, count in ((older, 1), (tmp_path / "copy.uwb", 0)):
        found = load(path)
        assert (found.tags[0].body, found.counts().get("height", 0)) == ("drone", count)


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
