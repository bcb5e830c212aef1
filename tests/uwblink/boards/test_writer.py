"""The writer of a live recording: what cannot be written is known at the start, or within a second."""

import threading
import time
from pathlib import Path

import pytest

from uwblink.boards import record as writing
from uwblink.boards.record import RecordingWriter
from uwblink.errors import RecordingError
from uwblink.recording.file import Recording
from uwblink.recording.schema import TABLES
from uwblink.recording.store import Store


@pytest.fixture
def live(tmp_path):
    with Recording.create(tmp_path / "live.uwb", live=True) as recording:
        yield recording


def test_the_trial_at_the_start_leaves_nothing(live):
    with RecordingWriter(live) as writer:
        writer.on_bytes(5, "port", "in", b"\x00\xff")
    assert [frame.data for frame in live.frames()] == [b"\x00\xff"]
    assert {table: live.count(table) for table in TABLES if table not in ("meta", "frames")} == dict.fromkeys(
        [table for table in TABLES if table not in ("meta", "frames")], 0
    )


@pytest.mark.parametrize(
    ("table", "column", "spoil"),
    [
        ("frames", "bytes", lambda data: data.replace(b"\xff", b"?")),
        ("cirs", "magnitudes", lambda taps: [min(tap, 32767) for tap in taps]),
        ("exchanges", "fpp1_dbm", round),
        ("faults", "detail", lambda text: text.replace("'", "")),
    ],
)
def test_a_library_that_writes_otherwise_is_found_before_anything_is_recorded(live, monkeypatch, table, column, spoil):
    plain = Store.insert

    def spoiling(store, name, columns):
        if name == table:
            spoiled = columns[column].copy()
            spoiled[:] = [spoil(value) for value in spoiled.tolist()]
            columns = dict(columns) | {column: spoiled}
        plain(store, name, columns)

    monkeypatch.setattr(Store, "insert", spoiling)
    with pytest.raises(RecordingError, match=rf"live\.uwb: written rows are read back differently \(tables: {table}\)"):
        RecordingWriter(live)
    assert live.count(table) == 0


def test_a_conversion_that_fails_is_no_full_disk(live, monkeypatch):
    plain = Store.execute

    def failing(store, statement, values=None):
        plain(store, statement.replace('unhex("bytes")', "CAST('\\xZZ' AS BLOB)"), values)

    monkeypatch.setattr(Store, "execute", failing)
    with pytest.raises(RecordingError, match="Conversion Error") as caught:
        RecordingWriter(live)
    assert "disk" not in str(caught.value)


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
