"""What docs/security.md says of a device on the cable, held against devices that try otherwise."""

import itertools
import re
import select
import threading
import tracemalloc
from contextlib import contextmanager

import pytest

import uwblink
from tests import processes
from uwblink.boards.listeners import Progress
from uwblink.boards.ports import Terminal
from uwblink.boards.recorder import Recorder
from uwblink.wire import messages as m
from uwblink.wire.codec import encode

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
    """A device that gives its id when it is asked, and anything at all to every other command; gives what it got."""
    terminal, over, got, answers = Terminal(link), threading.Event(), [], itertools.cycle(said)

    def serve():
        assert terminal.fileno is not None
        while not over.is_set():
            if select.select([terminal.fileno], [], [], 0.05)[0]:
                got.append(terminal.read())
                answer = encode(m.IdReport(board)) if b"C01" in got[-1] else next(answers)
                for at in range(0, len(answer), 1000):
                    terminal.write(answer[at : at + 1000])

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield got
    finally:
        over.set()
        thread.join()
        terminal.unplug()


def test_a_device_neither_steers_the_terminal_nor_ends_the_recorder_nor_writes_elsewhere(tmp_path):
    places = {board: tmp_path / "ports" / f"tag{board}" for board in (1, 2)}
    out = tmp_path / "out" / "f.uwb"
    out.parent.mkdir()
    # All of it after the first command: a board that does not answer is asked seldom.
    said = [b"".join(SAID), *SAID]
    with hostile(1, places[1], said) as got, hostile(2, places[2], said):
        words = ["record", *places.values(), "-o", out, "--pairs", "all", "--duration", "1"]
        done = processes.run("uwblink", *words, timeout=120)
    assert done.returncode == 0, done.stderr
    shown = processes.run("uwblink", "show", out, timeout=120)
    assert not CONTROLS.search(done.stdout + done.stderr + shown.stdout + shown.stderr)
    assert [path.name for path in out.parent.iterdir()] == ["f.uwb"]
    assert max(map(len, got)) <= 64, "no command has more bytes than a USB packet"
    with uwblink.Recording.open(out) as recording:
        kinds, frames = {fault.kind for fault in recording.faults()}, recording.frames()
    assert "garbage" in kinds
    assert sum(frame.data.count(b"\x1b") for frame in frames) > 0, "every byte is kept"


@pytest.mark.parametrize("words", [["test"], ["twr", "2"], ["cir", "2"]])
def test_a_command_to_a_hostile_device_ends_in_a_line(tmp_path, words):
    command, *rest = words
    with hostile(1, tmp_path / "tag1", SAID[:6]):
        done = processes.run("uwblink", command, tmp_path / "tag1", *rest, timeout=120)
    assert done.returncode in (0, 2)
    assert not CONTROLS.search(done.stdout + done.stderr)
    assert "Traceback" not in done.stderr


class Flooding:
    """Ports in virtual time of two boards that answer with their ids, and then with zeros without an end."""

    def __init__(self):
        self.time_s, self.said, self.piece = 0.0, 0, bytes(4096)
        self.open_ports: list[FloodingPort] = []

    def open(self, name):
        return FloodingPort(self, name)

    def close(self, port):
        self.open_ports = [p for p in self.open_ports if p is not port]

    def wait(self, _timeout_s):
        self.time_s += 0.001
        return self.open_ports

    def now_s(self):
        return self.time_s

    def host_ns(self):
        return int(1e18 + self.time_s * 1e9)

    def moved(self, name, _number):
        return name


class FloodingPort:
    def __init__(self, ports, name):
        self.ports, self.name, self.answer = ports, name, b""
        ports.open_ports = [*ports.open_ports, self]

    def read(self, timeout_s):
        self.ports.time_s += min(timeout_s, 0.001)
        data, self.answer = self.answer or self.ports.piece, b""
        self.ports.said += len(data)
        return data

    def write(self, data):
        if data == encode(m.GetId()):
            self.answer = encode(m.IdReport(int(self.name)))

    def now_s(self):
        return self.ports.time_s

    def close(self):
        pass


def test_zeros_without_an_end_are_faults_and_no_memory():
    """Nothing is written here, so that only the loop is measured."""
    ports, seen = Flooding(), Progress()
    recorder = Recorder({1: "1", 2: "2"}, uwblink.RangingPlan(((1, 2),)), ((1, 2),), [seen], ports=ports)
    tracemalloc.start()
    try:
        recorder.run(0.3)
        before, _ = tracemalloc.get_traced_memory()
        said = ports.said
        recorder._start_s = ports.time_s
        recorder.run(0.6)
        after, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert ports.said - said > 4e6
    assert most < before + 300_000
    assert after < before + 100_000
    assert seen.faults["garbage"] > 100
    assert len(seen.last_fault) < 300
    recorder.close()
