"""Listeners of a recorder, in virtual time: they receive all that is written to the file."""

import gc
import sys
import threading
import time
from pathlib import Path

import pytest

import uwblink
from benchmarks.hours import RATE_HZ, AnsweringPorts
from tests.boards import bench_scenario, record_bench
from tests.processes import wait_until
from uwblink.boards import record as writing
from uwblink.boards.recorder import Recorder
from uwblink.recording.schema import FrameRow
from uwblink.recording.store import Store
from uwblink.wire import RangeReport
from uwbsim import VirtualPorts


def recorded(path, *listeners, ports=None, seconds=2.0):
    return record_bench(path, None, ports, duration_s=seconds, listeners=listeners)


class Everything(uwblink.Listener):
    def __init__(self):
        self.bytes, self.turns, self.faults = {"in": b"", "out": b""}, [], []

    def on_bytes(self, time_ns, port, direction, data):
        self.bytes[direction] += data

    def on_turn(self, turn):
        self.turns.append(turn)

    def on_fault(self, fault):
        self.faults.append(fault)


def test_listeners_get_messages_bytes_turns_and_faults(tmp_path):
    ports, listener, heard = VirtualPorts(bench_scenario(), lost_share=0.4), Everything(), list[uwblink.Heard]()
    done = recorded(tmp_path / "f.uwb", listener, heard.append, ports=ports, seconds=2.0)
    reports = [(h.board, h.message.tx1) for h in heard if isinstance(h.message, RangeReport)]
    good = sum(turn.report is not None for turn in listener.turns)
    assert good == len(reports) == done.exchanges < done.tried == len(listener.turns)
    found = uwblink.load(tmp_path / "f.uwb")
    assert reports == list(zip(found.exchanges.initiator.tolist(), found.exchanges.tx1.tolist(), strict=True))
    assert [f.detail for f in listener.faults] == [f.detail for f in found.faults]
    for way in ("in", "out"):
        assert listener.bytes[way] == b"".join(f.data for f in found.frames if f.direction == way)


def damaged(ports, hit):
    """Damage the output of board 1 by the function `hit`."""
    arrived = ports.bench.send

    def send(time_ns, tag, data):
        arrived(time_ns, tag, hit(data) if tag == 1 else data)

    ports.bench.send = send


def test_one_damaged_line_is_one_fault(tmp_path):
    """An impulse response of 6000 bytes in 22 pieces, with one damaged byte in the middle."""
    ports, seen = VirtualPorts(bench_scenario()), []

    def hit(data):
        # The fifth piece of each response; bars within it are not the start of a message.
        seen.append(data)
        number = sum(d.startswith((b"|", b"S10")) for d in seen)
        return data[:10] + b"x" + data[11:] if data.startswith(b"|") and number % 21 == 5 else data

    damaged(ports, hit)
    plan = uwblink.RangingPlan(pairs=((1, 2),), rate_hz=5.0, get_cir=True)
    done = record_bench(tmp_path / "f.uwb", plan, ports, duration_s=4.0)
    assert (done.exchanges, done.tried, done.faults) == (20, 20, {"garbage": 20})


# The writer of a live recording: failures are noticed at the start, or within a second.


@pytest.fixture
def live(tmp_path):
    with uwblink.Recording.create(tmp_path / "live.uwb", live=True) as recording:
        yield recording


def size(path):
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def test_rows_are_committed_while_a_long_log_is_put_into_the_file(live, monkeypatch):
    """DuckDB does this within a commit unless it was done before; data that arrive meanwhile are not in the file."""
    begun, over = threading.Event(), threading.Event()
    monkeypatch.setattr(writing, "LONG_LOG", 20_000)

    def shorten_log(_):
        begun.set()
        over.wait(60)

    monkeypatch.setattr(uwblink.Recording, "shorten_log", shorten_log)
    log, written = Path(f"{live.path}.wal"), []
    with writing.RecordingWriter(live) as writer:
        writer.on_bytes(1, "port", "in", bytes(30_000))
        assert begun.wait(60)
        for k in range(3):
            before = size(log)
            writer.on_bytes(2 + k, "port", "in", bytes(100))
            wait_until(lambda: size(log) > before)  # noqa: B023 - called at once
            written.append(k)
        over.set()
    assert written == [0, 1, 2]


def test_a_log_stays_short_and_everything_is_in_the_file(live, monkeypatch):
    monkeypatch.setattr(writing, "LONG_LOG", 20_000)
    log, before = Path(f"{live.path}.wal"), live.path.stat().st_size
    with writing.RecordingWriter(live) as writer:
        writer.on_bytes(1, "port", "in", bytes(range(256)) * 100)
        wait_until(lambda: size(live.path) > before and size(log) < 20_000)
        writer.on_bytes(2, "port", "in", b"later")
    assert [frame.data for frame in live.frames()] == [bytes(range(256)) * 100, b"later"]


@pytest.mark.parametrize(
    "error", [MemoryError("no more"), RuntimeError("a bug"), uwblink.errors.RecordingError("disk full")]
)
def test_failures_of_writing_are_reported_within_a_second(live, monkeypatch, error):
    writer = writing.RecordingWriter(live)

    def failing(_recording, _table, _rows):
        raise error

    monkeypatch.setattr(uwblink.Recording, "append", failing)
    writer.on_bytes(5, "port", "in", b"x")
    begun = time.monotonic()
    with pytest.raises(uwblink.errors.RecordingError, match=str(error)):
        while time.monotonic() < begun + 10.0:  # ten, because of other load; it takes one period of the writer
            writer.check()
            time.sleep(0.01)
    with pytest.raises(uwblink.errors.RecordingError, match=str(error)):
        writer.close()


def test_a_slow_disk_is_reported_and_a_stopped_recorder_is_not_taken_for_one(live, monkeypatch):
    plain, later = time.monotonic, [0.0]
    with writing.RecordingWriter(live) as writer:
        writer.check()
        monkeypatch.setattr(time, "monotonic", lambda: plain() + later[0])
        later[0] = 3 * writing.LONGEST_BACKLOG_S  # Ctrl-Z, and a minute later fg
        writer.check()
        writer.on_bytes(5, "port", "in", b"x")
        monkeypatch.setattr(writer, "_write", lambda: None)
        with pytest.raises(uwblink.errors.RecordingError, match=r"the disk is 2\d s late"):
            for _ in range(60):  # the loop asks during all this time
                later[0] += 0.5
                writer.check()
        monkeypatch.undo()
        writer.behind_s = 0.0
    assert len(live.frames()) == 1


# A recorder that runs for hours needs no more memory than one that runs for seconds, and commits stay equal.


WARM, LATER, LONG = 1_100, 2_300, 2_400
EVERY = 100


class Committing(uwblink.Listener):
    """Commits after every few exchanges, in the loop itself, and stores the statements of each commit."""

    def __init__(self, recording, every=EVERY):
        self.recording, self.every, self.batch, self.exchanges = recording, every, [], 0
        self.asked, self.rows = [], []

    def on_bytes(self, time_ns, port, direction, data):
        self.batch.append(FrameRow(time_ns, port, direction, data))

    def on_message(self, heard):
        self.batch.append(heard)

    def on_turn(self, turn):
        self.exchanges += 1
        if self.exchanges % self.every == 0:
            self.commit()

    def commit(self):
        before = len(STATEMENTS)
        self.rows.append(len(self.batch))
        with self.recording.transaction():
            writing.append_rows(self.recording, self.batch)
        self.asked.append(STATEMENTS[before:])
        self.batch = []


STATEMENTS: list[str] = []


@pytest.fixture
def statements(monkeypatch):
    execute = Store._execute

    def noted(store, statement, values=None):
        STATEMENTS.append(statement)
        execute(store, statement, values)

    monkeypatch.setattr(Store, "_execute", noted)
    yield STATEMENTS
    STATEMENTS.clear()


@pytest.mark.slow
def test_nothing_grows_with_the_recording(tmp_path, statements):
    ports, held = AnsweringPorts(), {}
    with uwblink.Recording.create(tmp_path / "long.uwb", live=True) as recording:
        committing = Committing(recording)
        found = writing.identify(ports.names, ports)
        plan = uwblink.RangingPlan(ports.pairs[:1], rate_hz=RATE_HZ)
        recorder = Recorder(found, plan, plan.turns(sorted(found)), [committing], ports=ports)
        for _ in recorder.steps(stop=lambda: committing.exchanges >= LONG):
            if committing.exchanges in (WARM, LATER) and committing.exchanges not in held:
                statements.clear()
                committing.asked, committing.rows = committing.asked[-5:], committing.rows[-5:]
                gc.collect()
                held[committing.exchanges] = len(gc.get_objects()), sys.getallocatedblocks()
        recorder.finish()
        assert recorder.progress.exchanges >= LONG
        assert recording.count("exchanges") == LONG
    (objects, blocks), (objects_later, blocks_later) = held.values()
    # Each exchange that stays would be some objects and blocks of memory more, and there were 1,200; the last 1,000 of
    # a pair are kept.
    assert objects_later - objects < 200
    assert blocks_later - blocks < 1_000
    assert (len(set(committing.rows)), len({tuple(asked) for asked in committing.asked})) == (1, 1)
