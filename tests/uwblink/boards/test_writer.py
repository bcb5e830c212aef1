"""The writer of a live recording: what cannot be written is known at the start, or within a second."""

import threading
import time
from pathlib import Path

import pytest

from uwblink.boards import record as writing
from uwblink.boards.record import RecordingWriter
from uwblink.errors import RecordingError
from uwblink.recording.file import Recording


@pytest.fixture
def live(tmp_path):
    with Recording.create(tmp_path / "live.uwb", live=True) as recording:
        yield recording


def size(path):
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0


def until(true):
    """Wait for something that another thread does."""
    end_s = time.monotonic() + 60.0
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.005)


def test_rows_are_committed_while_a_long_log_is_put_into_the_file(live, monkeypatch):
    """DuckDB does that within a commit where nobody did it before, and what comes meanwhile is not in the file."""
    begun, over = threading.Event(), threading.Event()
    monkeypatch.setattr(writing, "LONG_LOG", 20_000)

    def shorten_log(_):
        begun.set()
        over.wait(60)

    monkeypatch.setattr(Recording, "shorten_log", shorten_log)
    log, written = Path(f"{live.path}.wal"), []
    with RecordingWriter(live) as writer:
        writer.on_bytes(1, "port", "in", bytes(30_000))
        assert begun.wait(60)
        for k in range(3):
            before = size(log)
            writer.on_bytes(2 + k, "port", "in", bytes(100))
            until(lambda least=before: size(log) > least)
            written.append(k)
        over.set()
    assert written == [0, 1, 2]


def test_a_log_stays_short_and_everything_is_in_the_file(live, monkeypatch):
    monkeypatch.setattr(writing, "LONG_LOG", 20_000)
    log, before = Path(f"{live.path}.wal"), live.path.stat().st_size
    with RecordingWriter(live) as writer:
        writer.on_bytes(1, "port", "in", bytes(range(256)) * 100)
        until(lambda: size(live.path) > before and size(log) < 20_000)
        writer.on_bytes(2, "port", "in", b"later")
    assert [frame.data for frame in live.frames()] == [bytes(range(256)) * 100, b"later"]


@pytest.mark.parametrize("error", [MemoryError("no more"), RuntimeError("a bug"), RecordingError("disk full")])
def test_whatever_ends_the_writing_is_told_within_a_second(live, monkeypatch, error):
    writer = RecordingWriter(live)

    def failing(_recording, _table, _rows):
        raise error

    monkeypatch.setattr(Recording, "append", failing)
    writer.on_bytes(5, "port", "in", b"x")
    begun = time.monotonic()
    with pytest.raises(RecordingError, match=str(error)):
        while time.monotonic() < begun + 10.0:  # ten for a busy machine; it takes one period of the writer
            writer.check()
            time.sleep(0.01)
    with pytest.raises(RecordingError, match=str(error)):
        writer.close()
