"""A recording is read by other processes while it is written: they get all committed rows, and leave no files."""

import json
import os
import subprocess
import sys
import time

import pytest

import uwblink
from tests import processes
from tests.boards import bench_scenario
from uwblink.errors import RecordingInUseError
from uwblink.recording.file import Recording
from uwbsim.boards.virtual_board import VirtualPorts

WRITE = """
import sys, time, uwblink
from uwblink.recording.schema import Fault
with uwblink.Recording.create(sys.argv[1], live=True) as recording:
    for k in range(50):
        recording.append("faults", [Fault(k, "1", "kind", f"row {k}")])
    print("writing", flush=True)
    time.sleep(60)
"""


class Reader(uwblink.Listener):
    """Reads the recording in another process after some number of exchanges, until it has `found` them."""

    def __init__(self, path, at):
        self.path, self.at, self.turns, self.found = path, at, 0, 0

    def on_turn(self, turn):
        self.turns += turn.report is not None
        if self.turns == self.at:
            until_s = time.monotonic() + 60.0  # the writer commits every 0.1 s, and later under load
            while self.found != self.at and time.monotonic() < until_s:
                shown = processes.fork("uwblink", "show", "--json", self.path).stdout
                self.found = json.loads(shown)["counts"]["exchanges"]


def test_another_process_reads_what_is_recorded_so_far(tmp_path):
    path = tmp_path / "f's.uwb"
    reader, ports = Reader(path, 100), VirtualPorts(bench_scenario())
    plan = uwblink.RangingPlan(rate_hz=100.0)
    uwblink.record(ports.names.values(), path, plan, duration_s=2.0, listeners=[reader], using=ports)
    assert reader.found == 100
    assert [p.name for p in tmp_path.iterdir()] == [path.name], "no copy, no log is left"
    assert len(uwblink.load(path).exchanges) > 100


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
    with pytest.raises(RecordingInUseError, match="has it open; wait"):
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
    with pytest.raises(RecordingInUseError, match=f"another process is writing it, and it {why}; wait until that"):
        Recording.open(writer)
    assert sorted(p.name for p in writer.parent.iterdir()) == ["f.uwb", "f.uwb.wal"]
