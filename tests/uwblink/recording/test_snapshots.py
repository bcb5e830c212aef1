"""A recording can be read by others while it is written: they get everything until now, and leave nothing behind."""

import json
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

import uwblink
from tests.boards import bench_scenario
from uwblink.errors import RecordingError, RecordingInUseError
from uwblink.recording.file import Recording, SnapshotMaker, open_snapshot
from uwblink.recording.schema import Fault
from uwbsim.boards.virtual_board import VirtualPorts

BIN = Path(sys.executable).parent
READ = "import sys, uwblink\nwith uwblink.Recording.open(sys.argv[1]) as r: print(len(r.exchanges()))"

WRITE = """
import sys, time, uwblink
with uwblink.Recording.create(sys.argv[1], live=True):
    print("writing", flush=True)
    time.sleep(60)
"""


def read_elsewhere(path, *command):
    words = command or (sys.executable, "-c", READ, str(path))
    return subprocess.run(words, capture_output=True, text=True, timeout=120)


class Reader(uwblink.Listener):
    """Reads the recording in another process when so many exchanges have been told of; `found` is what it says."""

    def __init__(self, path, at, command=()):
        self.path, self.at, self.command, self.turns, self.found = path, at, command, 0, []

    def on_turn(self, turn):
        self.turns += turn.report is not None
        if self.turns == self.at:
            time.sleep(0.5)  # the writer commits every 0.1 s
            self.found.append(read_elsewhere(self.path, *self.command))


@pytest.mark.parametrize("command", [(), (str(BIN / "uwblink"), "show", "--json")])
def test_another_process_reads_what_is_recorded_so_far(tmp_path, command):
    path = tmp_path / "f's.uwb"
    reader = Reader(path, 300, (*command, str(path)) if command else ())
    ports = VirtualPorts(bench_scenario())
    plan = uwblink.RangingPlan(rate_hz=100.0)
    uwblink.record(ports.names.values(), path, plan, duration_s=5.0, listeners=[reader], using=ports)
    (done,) = reader.found
    assert done.returncode == 0, done.stderr
    read = json.loads(done.stdout)["counts"]["exchanges"] if command else int(done.stdout)
    assert read == 300
    assert [p.name for p in tmp_path.iterdir()] == [path.name], "no request, no snapshot, no log is left"
    with Recording.open(path) as recording:
        assert len(recording.exchanges()) > 300


def test_rows_are_the_same_and_in_their_order(tmp_path):
    with Recording.create(tmp_path / "f.uwb", live=True) as recording:
        for k in range(50):
            with recording.transaction():
                recording.append("faults", [Fault(50 - k, "1", "kind", f"row {k}")])
        recording.snapshot(tmp_path / "s.uwb")
        recording.append("faults", [Fault(99, "1", "kind", "later")])
    with Recording.open(tmp_path / "s.uwb") as copy:
        assert {f.detail for f in copy.faults()} == {f"row {k}" for k in range(50)}
        with Recording.open(tmp_path / "f.uwb") as whole:
            assert copy.meta() == whole.meta()
            assert len(whole.faults()) == 51


def test_a_writer_that_makes_no_snapshots_is_named_soon(tmp_path):
    path = tmp_path / "f.uwb"
    writer = subprocess.Popen([sys.executable, "-c", WRITE, str(path)], stdout=subprocess.PIPE)
    try:
        writer.stdout.readline()
        with pytest.raises(RecordingInUseError, match="is writing it, and it makes no snapshots; wait until that ends"):
            Recording.open(path)
        with pytest.raises(RecordingInUseError, match="has it open; wait"):
            Recording.open(path, update=True)
    finally:
        writer.kill()
        writer.communicate()
    assert {p.suffix for p in tmp_path.iterdir()} <= {".uwb", ".wal"}
    Recording.open(path).__exit__(None, None, None)


def test_a_snapshot_that_cannot_be_written_is_an_error_of_the_reader_alone(tmp_path):
    path = tmp_path / "f.uwb"
    path.touch()
    begun = threading.Event()

    def make(place):
        begun.set()
        raise RecordingError("disk full")

    maker = SnapshotMaker(path, make)
    stop = threading.Event()

    def look():
        while not stop.wait(0.02):
            maker.look()

    thread = threading.Thread(target=look)
    thread.start()

    def reopen(place):
        raise RecordingInUseError("still in use")

    try:
        with pytest.raises(RecordingInUseError, match="makes no snapshots"):
            open_snapshot(path, reopen)
    finally:
        stop.set()
        thread.join()
    assert begun.is_set()
    assert [p.name for p in tmp_path.iterdir()] == ["f.uwb"]


def test_what_killed_processes_have_left_is_swept_away(tmp_path):
    for kind in (".wanted", ".snapshot", ".partial"):
        (tmp_path / f".f.uwb.123{kind}").touch()
    (tmp_path / ".f.uwb.456.partial" / "f.uwb").mkdir(parents=True)
    (tmp_path / ".other.uwb.123.wanted").touch()
    SnapshotMaker(tmp_path / "f.uwb", lambda place: None)
    assert [p.name for p in tmp_path.iterdir()] == [".other.uwb.123.wanted"]
