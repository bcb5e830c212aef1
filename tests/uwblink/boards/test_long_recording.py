"""A recorder that runs for hours holds no more than one that runs for seconds, and each commit does the same work."""

import gc
import sys

import pytest

from benchmarks.hours import RATE_HZ, AnsweringPorts
from uwblink.boards.listeners import Listener
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.record import append_rows, identify, record
from uwblink.boards.recorder import Recorder
from uwblink.recording.file import Recording
from uwblink.recording.schema import FrameRow

WARM, LATER, LONG = 1_100, 2_300, 2_400
EVERY = 100


class Committing(Listener):
    """Commits after every so many exchanges, in the loop itself, and notes what each commit asked of the database."""

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
            append_rows(self.recording, self.batch)
        self.asked.append(STATEMENTS[before:])
        self.batch = []


STATEMENTS: list[str] = []


@pytest.fixture
def statements(monkeypatch):
    from uwblink.recording.store import Store

    execute = Store._execute

    def noted(store, statement, values=None):
        STATEMENTS.append(statement)
        execute(store, statement, values)

    monkeypatch.setattr(Store, "_execute", noted)
    yield STATEMENTS
    STATEMENTS.clear()


def test_nothing_grows_with_the_recording(tmp_path, statements):
    ports, held = AnsweringPorts(), {}
    with Recording.create(tmp_path / "long.uwb", live=True) as recording:
        committing = Committing(recording)
        found = identify(ports.names, ports)
        plan = RangingPlan(ports.pairs[:1], rate_hz=RATE_HZ)
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
    # Each exchange that stayed would be some objects and blocks of memory more, and there were 1,200 in between; of a
    # pair the last 1,000 are kept.
    assert objects_later - objects < 200
    assert blocks_later - blocks < 1_000
    assert len(set(committing.rows)) == 1
    assert len({tuple(asked) for asked in committing.asked}) == 1


def test_the_time_of_a_recording_is_that_of_its_boards(tmp_path):
    ports = AnsweringPorts()
    plan = RangingPlan(ports.pairs, rate_hz=RATE_HZ)
    done = record(ports.names, tmp_path / "r.uwb", plan, duration_s=3.0, using=ports)
    with Recording.open(tmp_path / "r.uwb") as recording:
        x = recording.exchanges()
    assert len(x) == done.exchanges == pytest.approx(3.0 * RATE_HZ, abs=2)
    assert not done.faults
