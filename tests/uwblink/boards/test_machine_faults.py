"""The recorder while its machine misbehaves: clocks are set, the process is stopped, its file or folder goes away."""

import os
import subprocess
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from tests.boards import bench_scenario, served
from tests.processes import run
from uwblink.boards.listeners import Listener
from uwblink.boards.ports import SerialPorts
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.record import LONGEST_BACKLOG_S, RecordingWriter, record
from uwblink.errors import RecordingError
from uwblink.recording.file import Recording
from uwbsim.boards.virtual_board import VirtualPorts

HOUR_NS = 3600 * 10**9


class After(Listener):
    """Does things after so many turns of the plan."""

    def __init__(self, **what):
        self.turns, self._what = 0, {int(name[1:]): do for name, do in what.items()}

    def on_turn(self, turn):
        self.turns += 1
        self._what.get(self.turns, lambda: None)()


def exchanges_of(path):
    with Recording.open(path) as recording:
        return recording.exchanges(), [fault.kind for fault in recording.faults()]


def test_an_hour_forward_and_back_on_the_wall_changes_no_time_in_the_file(tmp_path, monkeypatch):
    path, set_by, plain = tmp_path / "f.uwb", [0], time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: plain() + set_by[0])
    monkeypatch.setattr(time, "time", lambda: time.time_ns() * 1e-9)
    clock = After(t20=lambda: set_by.__setitem__(0, HOUR_NS), t40=lambda: set_by.__setitem__(0, -HOUR_NS))
    before = plain()
    with served() as server:
        ports = list(server.names.values())
        record(ports, path, RangingPlan(), duration_s=60.0, listeners=[clock], stop=lambda: clock.turns > 60)
    exchanges, _ = exchanges_of(path)
    assert len(exchanges) > 50
    times = np.sort(exchanges.time_ns)
    # As long as the test took, and not an hour.
    assert before - 10**9 < times[0] < times[-1] < plain() + 10**9


def test_host_time_goes_on_while_the_computer_is_suspended(monkeypatch):
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    if boot is None:
        pytest.skip("this system has no clock that counts suspension")
    ports, plain = SerialPorts(), time.clock_gettime_ns
    first = ports.host_ns()
    monkeypatch.setattr(time, "clock_gettime_ns", lambda clock: plain(clock) + 5 * 10**9 * (clock == boot))
    assert 5.0 <= (ports.host_ns() - first) * 1e-9 < 60.0


class Suspended(VirtualPorts):
    """Ports of a computer that is suspended for five seconds, while the boards go on."""

    left_out_ns = 5 * 10**9
    at_ns = 10**9

    def wait(self, timeout_s):
        ready = super().wait(timeout_s)
        if self.now_ns() > self.at_ns and self.left_out_ns:
            self.bench.advance(self.now_ns() + self.left_out_ns)
            self.left_out_ns = 0
        return ready


def test_five_seconds_of_suspension_are_a_gap_and_nothing_else(tmp_path):
    path, ports = tmp_path / "f.uwb", Suspended(bench_scenario())
    done = record(ports.names.values(), path, RangingPlan(rate_hz=50.0), duration_s=8.0, using=ports)
    exchanges, kinds = exchanges_of(path)
    gaps = np.diff(np.sort(exchanges.time_ns)) * 1e-9
    assert 4.9 < gaps.max() < 5.2
    # No burst makes up for the gap. The exchange in which it fell may have failed, or its report waited all the while.
    assert len(exchanges) == pytest.approx(150, abs=5)
    assert np.median(gaps) == pytest.approx(0.02, rel=0.1)
    assert np.sort(gaps)[1] > 0.01
    assert len(kinds) <= 1
    assert done.tried - done.exchanges <= 1


@pytest.fixture
def live(tmp_path):
    with Recording.create(tmp_path / "live.uwb", live=True) as recording:
        yield recording


def test_a_recorder_that_was_stopped_does_not_blame_the_disk(live, monkeypatch):
    plain, later = time.monotonic, [0.0]
    with RecordingWriter(live) as writer:
        writer.check()
        monkeypatch.setattr(time, "monotonic", lambda: plain() + later[0])
        later[0] = 3 * LONGEST_BACKLOG_S  # Ctrl-Z, and a minute later fg
        writer.check()
        writer.on_bytes(5, "port", "in", b"x")
    assert len(live.frames()) == 1


def test_a_disk_that_is_late_is_still_told(live, monkeypatch):
    plain, later = time.monotonic, [0.0]
    with RecordingWriter(live) as writer:
        monkeypatch.setattr(time, "monotonic", lambda: plain() + later[0])
        monkeypatch.setattr(writer, "_write", lambda: None)
        with pytest.raises(RecordingError, match=r"the disk is 2\d s behind"):
            for _ in range(60):  # the loop asks all the while
                later[0] += 0.5
                writer.check()
        monkeypatch.undo()
        writer.behind_s = 0.0


@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_that_is_removed_under_the_recorder_is_told_within_a_second(tmp_path, replaced):
    path = tmp_path / "f.uwb"
    begun = []

    def remove():
        path.unlink()
        if replaced:
            path.write_text("mine")
        begun.append(time.monotonic())

    with served() as server, pytest.raises(RecordingError, match=r"f\.uwb: was removed or replaced while"):
        record(server.names.values(), path, RangingPlan(), duration_s=60.0, listeners=[After(t20=remove)])
    assert time.monotonic() < begun[0] + 20.0  # a second on a machine that has nothing else to do
    assert not replaced or path.read_text() == "mine"


NOBODY = 65534


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give its rights away, and take a folder's from another")
def test_a_folder_made_read_only_under_the_recorder_takes_nothing_away():
    """By an ordinary user, whose right to the folder goes while it records: it says so, and nothing is lost."""
    with TemporaryDirectory(dir="/tmp") as place:
        folder, path = Path(place), Path(place) / "f.uwb"
        folder.chmod(0o777)

        def lock():
            os.seteuid(0)
            folder.chmod(0o555)
            os.seteuid(NOBODY)

        ports = VirtualPorts(bench_scenario())
        os.seteuid(NOBODY)
        try:
            after = After(t20=lock)
            with pytest.raises(RecordingError, match=r"any more \(.*Permission denied\).* everything before is kept"):
                record(ports.names.values(), path, RangingPlan(), using=ports, duration_s=2.0, listeners=[after])
            exchanges, kinds = exchanges_of(path)
        finally:
            os.seteuid(0)
            folder.chmod(0o777)
        assert len(exchanges) == after.turns > 500
        assert kinds == []


def test_two_recorders_cannot_have_one_file(tmp_path):
    path = tmp_path / "f.uwb"
    found: list[subprocess.CompletedProcess[str]] = []

    def second():
        with served() as other:
            words = ["uwblink", "record", *other.names.values(), "-o", path, "--pairs", "all", "--duration", "1"]
            found.extend(run(*words, *force) for force in ((), ("--force",)))
        found.append(run("uwblink", "import", "csv", "docs/examples/exchanges.csv", "-o", path, "--force"))

    ports = VirtualPorts(bench_scenario())
    record(ports.names.values(), path, RangingPlan(), duration_s=2.0, using=ports, listeners=[After(t20=second)])
    assert [ended.returncode for ended in found] == [2, 2, 2]
    assert "exists already" in found[0].stderr
    for ended in found[1:]:
        assert ended.stderr == f"error: {path}: another process is writing it; give another name\n"
    exchanges, kinds = exchanges_of(path)
    assert len(exchanges) > 50
    assert kinds == []
