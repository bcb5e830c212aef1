"""The recorder during faults of the computer: clocks are set, the process is stopped, its file or folder is removed."""

import itertools
import os
import re
import subprocess
import time
import tracemalloc
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

import uwblink
from benchmarks.hours import AnsweringPort, AnsweringPorts
from tests import processes
from tests.boards import After, bench_scenario, device, record_bench, served
from uwblink.boards.listeners import Progress
from uwblink.boards.ports import SerialPorts
from uwblink.boards.recorder import Recorder
from uwblink.wire import messages as m
from uwblink.wire.codec import encode
from uwbsim.boards.virtual_board import VirtualPorts

HOUR_NS = 3600 * 10**9


def exchanges_of(path):
    found = uwblink.load(path)
    return found.exchanges, [fault.kind for fault in found.faults]


def test_setting_the_host_clock_changes_no_times(tmp_path, monkeypatch):
    path, set_by, plain = tmp_path / "f.uwb", [0], time.time_ns
    monkeypatch.setattr(time, "time_ns", lambda: plain() + set_by[0])
    monkeypatch.setattr(time, "time", lambda: time.time_ns() * 1e-9)
    clock = After(t20=lambda: set_by.__setitem__(0, HOUR_NS), t40=lambda: set_by.__setitem__(0, -HOUR_NS))
    before = plain()
    with served() as server:
        ports = list(server.names.values())
        uwblink.record(
            ports, path, uwblink.RangingPlan(), duration_s=60.0, listeners=[clock], stop=lambda: clock.turns > 60
        )
    time_ns = uwblink.load(path).exchanges.time_ns
    assert len(time_ns) > 50
    # The duration of the test, and not an hour.
    assert before - 10**9 < time_ns.min() < time_ns.max() < plain() + 10**9


def test_host_time_continues_during_suspension(monkeypatch):
    boot = getattr(time, "CLOCK_BOOTTIME", None)
    if boot is None:
        pytest.skip("this system has no clock that counts suspension")
    ports, plain = SerialPorts(), time.clock_gettime_ns
    first = ports.host_ns()
    monkeypatch.setattr(time, "clock_gettime_ns", lambda clock: plain(clock) + 5 * 10**9 * (clock == boot))
    assert 5.0 <= (ports.host_ns() - first) * 1e-9 < 60.0


class Suspended(VirtualPorts):
    """Ports of a computer that is suspended for five seconds, while the boards continue."""

    left_out_ns = 5 * 10**9
    at_ns = 10**9

    def wait(self, ports, timeout_s):
        ready = super().wait(ports, timeout_s)
        if self.now_ns() > self.at_ns and self.left_out_ns:
            self.bench.advance(self.now_ns() + self.left_out_ns)
            self.left_out_ns = 0
        return ready


def test_suspension_is_only_a_gap(tmp_path):
    done = record_bench(tmp_path / "f.uwb", None, Suspended(bench_scenario()), duration_s=8.0)
    exchanges, kinds = exchanges_of(tmp_path / "f.uwb")
    gaps = np.diff(np.sort(exchanges.time_ns)) * 1e-9
    assert 4.9 < gaps.max() < 5.2
    # No burst compensates the gap. The exchange at its start may have failed, or its report waited during the gap.
    assert len(exchanges) == pytest.approx(150, abs=5)
    assert np.median(gaps) == pytest.approx(0.02, rel=0.1)
    assert np.sort(gaps)[1] > 0.01
    assert max(len(kinds), done.tried - done.exchanges) <= 1


@pytest.mark.parametrize("replaced", [False, True])
def test_a_removed_file_is_reported_within_a_second(tmp_path, replaced):
    path = tmp_path / "f.uwb"
    begun = []

    def remove():
        path.unlink()
        if replaced:
            path.write_text("mine")
        begun.append(time.monotonic())

    with (
        served() as server,
        pytest.raises(uwblink.errors.RecordingError, match=r"f\.uwb: was removed or replaced during"),
    ):
        uwblink.record(
            server.names.values(), path, uwblink.RangingPlan(), duration_s=60.0, listeners=[After(t20=remove)]
        )
    assert time.monotonic() < begun[0] + 20.0  # a second on an idle machine
    assert not replaced or path.read_text() == "mine"


NOBODY = 65534


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give its rights away, and take a folder's from another")
def test_a_read_only_folder_loses_no_data():
    """An ordinary user loses the right to write to the folder during the recording: the recorder reports it, and
    nothing is lost.
    """
    with TemporaryDirectory(dir="/tmp") as place:
        folder, path = Path(place), Path(place) / "f.uwb"
        folder.chmod(0o777)

        def lock():
            os.seteuid(0)
            folder.chmod(0o555)
            os.seteuid(NOBODY)

        after = After(t20=lock)
        os.seteuid(NOBODY)
        try:
            with pytest.raises(
                uwblink.errors.RecordingError, match=r"any more \(.*Permission denied\).* everything before is kept"
            ):
                record_bench(path, uwblink.RangingPlan(), duration_s=1.0, listeners=[after])
            exchanges, kinds = exchanges_of(path)
        finally:
            os.seteuid(0)
            folder.chmod(0o777)
        assert (len(exchanges), kinds) == (after.turns, [])
        assert after.turns > 200


@pytest.mark.slow
def test_two_recorders_cannot_have_one_file(tmp_path):
    path = tmp_path / "f.uwb"
    found: list[subprocess.CompletedProcess[str]] = []

    def second():
        with served() as other:
            words = ["uwblink", "record", *other.names.values(), "-o", path, "--pairs", "all", "--force"]
            found.append(processes.fork(*words, "--duration", "1"))
        found.append(processes.fork("uwblink", "import", "csv", "docs/examples/exchanges.csv", "-o", path, "--force"))

    record_bench(path, uwblink.RangingPlan(), duration_s=2.0, listeners=[After(t20=second)])
    told = f"error: {path}: another process is writing it; give another name\n"
    assert [(ended.returncode, ended.stderr) for ended in found] == [(2, told)] * 2
    exchanges, kinds = exchanges_of(path)
    assert (len(exchanges) > 50, kinds) == (True, [])


# Statements of docs/security.md on a device at the cable, tested with hostile devices.


END = 2**32 - 1
TITLE = b"\x1b]0;owned\x07\x1b[2J\x1b[31m"
RANGE = m.RangeReport(2, 3.0, 1, 2, 3, 4, 5, 6, -85.0, -86.0, 1.0, -1.0)
SAID = [
    TITLE + b"\r\n",
    b"R03|0|1|" + TITLE + b"|1|1.0000|\x02\x00ab\r\n",
    encode(m.BroadcastReceived(b"\r\n" + TITLE + b"[red]\r\nR05|")),
    b"COMMANDED TASK FAILED" + TITLE + b"\r\n",
    b"R05|2|" + b"9" * 300 + b"\r\n",
    b"R05|" + b"\x9b31m|" * 12 + b"\r\n",
    b"\x00" * 100_000,
    b"S10|1|2|" + b"1|" * 5000,
    b"R00\r\n" * 2000,
    encode(m.IdReport(77)) * 20,
    encode(m.TargetRangeReport(255, -999.0, END, END, END, END, END, END, 0.0, 0.0, 0.0, 0.0)) * 20,
    encode(m.OverheardNothing(255, 255)),
    encode(RANGE),
]
CONTROLS = re.compile(r"[\x00-\x09\x0b-\x1f\x7f-\x9f]")


@contextmanager
def hostile(board, link, said):
    """A device that returns its id when asked, and random bytes for every other command; yields its input."""
    got, answers = [], itertools.cycle(said)

    def step(terminal):
        if data := terminal.read():
            got.append(data)
            answer = encode(m.IdReport(board)) if b"C01" in data else next(answers)
            for at in range(0, len(answer), 1000):
                terminal.write(answer[at : at + 1000])

    with device(step, link):
        yield got


def test_hostile_devices_have_no_effect(tmp_path):
    places = {board: tmp_path / "ports" / f"tag{board}" for board in (1, 2)}
    out = tmp_path / "out" / "f.uwb"
    out.parent.mkdir()
    # All after the first command: a board that does not answer is asked rarely.
    said = [b"".join(SAID), *SAID]
    with hostile(1, places[1], said) as got, hostile(2, places[2], said):
        words = ["record", *places.values(), "-o", out, "--pairs", "all", "--duration", "1"]
        done = processes.succeed("uwblink", *words, timeout=120)
    shown = processes.run("uwblink", "show", out, timeout=120)
    assert not CONTROLS.search(done.stdout + done.stderr + shown.stdout + shown.stderr)
    assert [path.name for path in out.parent.iterdir()] == ["f.uwb"]
    assert max(map(len, got)) <= 64, "no command has more bytes than a USB packet"
    held = uwblink.load(out)
    assert "garbage" in {fault.kind for fault in held.faults}
    assert any(b"\x1b" in frame.data for frame in held.frames), "every byte is kept"


@pytest.mark.parametrize(("command", "rest"), [("test", []), ("twr", ["2"]), ("cir", ["2"])])
def test_commands_to_hostile_devices_end_with_one_line(tmp_path, command, rest):
    with hostile(1, tmp_path / "tag1", SAID[:6]):
        done = processes.run("uwblink", command, tmp_path / "tag1", *rest, timeout=120)
    assert done.returncode in (0, 2)
    assert not CONTROLS.search(done.stdout + done.stderr)
    assert "Traceback" not in done.stderr


ZEROS = bytes(4096)


class FloodingPort(AnsweringPort):
    said = 0

    def read(self, timeout_s):
        data = super().read(timeout_s) or ZEROS
        FloodingPort.said += len(data)
        return data


class Flooding(AnsweringPorts):
    """Ports in virtual time of boards that answer with their ids, and have more zeros whenever they are read."""

    def open(self, name):
        return FloodingPort(self, name)

    def answer(self, board, data):
        return encode(m.IdReport(board)) if data == encode(m.GetId()) else b""

    def wait(self, ports, timeout_s):
        super().wait(ports, min(timeout_s, 0.001))
        return ports


def test_endless_zeros_are_faults_and_need_no_memory():
    """Nothing is written, so that only the loop is measured."""
    ports, seen = Flooding(), Progress()
    recorder = Recorder({1: "1", 2: "2"}, uwblink.RangingPlan(((1, 2),)), ((1, 2),), [seen], ports=ports)
    tracemalloc.start()
    try:
        recorder.run(0.3)
        before, _ = tracemalloc.get_traced_memory()
        said = FloodingPort.said
        recorder._start_s = ports.now_s()
        recorder.run(0.6)
        after, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    recorder.close()
    assert FloodingPort.said - said > 4e6
    assert (most < before + 300_000, after < before + 100_000) == (True, True), (before, most, after)
    assert (seen.faults["garbage"] > 100, len(seen.last_fault) < 300) == (True, True), seen
