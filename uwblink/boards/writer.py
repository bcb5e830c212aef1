"""The file writer of a recorder: what was heard, collected by the loop, written by a thread of its own.

The thread commits every `FLUSH_S`, so that a slow disk never makes the loop miss bytes, and nothing that was handed
over is longer out of the file than that and the commit itself.
"""

from __future__ import annotations

import threading
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import numpy as np

from uwblink.boards.listeners import Heard, Listener
from uwblink.database import log_of
from uwblink.errors import RecordingError
from uwblink.recording.file import Recording, SnapshotMaker
from uwblink.recording.schema import CirRow, Fault, FrameRow
from uwblink.twr import Exchanges
from uwblink.wire.bulk import exchanges_of
from uwblink.wire.messages import Cir, Overheard, RangeReport

FLUSH_S: Final = 0.1
LONGEST_BACKLOG_S: Final = 20.0
LONG_LOG: Final = 8 * 2**20
"""Half of the bytes at which DuckDB puts its log into the file within a commit, which takes a second on a busy machine.
"""

STOPPED_S: Final = 2.0
"""A loop that does not ask for so long was stopped with its process (Ctrl-Z, a suspended computer)."""


@dataclass(slots=True)
class Batch:
    """Rows that wait to be written, in the order in which they came."""

    frames: list[FrameRow] = field(default_factory=list)
    exchanges: list[tuple[int, int, RangeReport]] = field(default_factory=list)
    overheard: list[tuple[int, int, Overheard]] = field(default_factory=list)
    cirs: list[tuple[int, int, Cir]] = field(default_factory=list)
    faults: list[Fault] = field(default_factory=list)

    def __bool__(self) -> bool:
        """Whether there is anything to write."""
        return bool(self.frames or self.exchanges or self.overheard or self.cirs or self.faults)

    def add(self, heard: Heard) -> None:
        """Put a message into the list of its table; what belongs to none is in the bytes."""
        row = heard.time_ns, heard.board
        if isinstance(heard.message, RangeReport):
            self.exchanges.append((*row, heard.message))
        elif isinstance(heard.message, Overheard):
            self.overheard.append((*row, heard.message))
        elif isinstance(heard.message, Cir):
            self.cirs.append((*row, heard.message))

    def write(self, recording: Recording) -> None:
        """Append everything in one transaction; raises `RecordingError`."""
        with recording.transaction():
            self.append_to(recording)

    def append_to(self, recording: Recording) -> None:
        """Append everything; raises `RecordingError`."""
        recording.append_frames(self.frames)
        if self.exchanges:
            recording.append_exchanges(exchanges_of(self.exchanges))
        recording.append_overheard(overheard_row(*row) for row in self.overheard)
        recording.append_cirs(
            CirRow(t, board, c.initiator, c.target, c.first_path_milli / 1000, c.magnitudes)
            for t, board, c in self.cirs
        )
        recording.append_faults(self.faults)


class RecordingWriter(Listener):
    """A listener that writes a live recording. A context manager: leaving it writes what is left."""

    def __init__(self, recording: Recording) -> None:
        """Begin writing; raises `RecordingError` where what would be written cannot be read back."""
        check_writing(recording)
        self._recording = recording
        self._batch = Batch()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._written_s = self._checked_s = time.monotonic()
        self._stopped_s = 0.0
        self._file = _identity(recording.path)
        self._error: RecordingError | None = None
        self._snapshots = SnapshotMaker(recording.path, recording.snapshot)
        self._shortening: threading.Thread | None = None
        self._thread = threading.Thread(target=self._work, name="uwblink writer", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        """Return the writer."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Write what is left; raises what `check` raises, unless something else is already on its way up."""
        try:
            self.close()
        except RecordingError:
            if kind is None:
                raise

    def on_bytes(self, time_ns: int, port: str, direction: str, data: bytes) -> None:
        """Keep bytes."""
        with self._lock:
            self._batch.frames.append(FrameRow(time_ns, port, direction, data))

    def on_message(self, heard: Heard) -> None:
        """Keep a message in the table of its kind."""
        with self._lock:
            self._batch.add(heard)

    def on_fault(self, fault: Fault) -> None:
        """Keep a fault."""
        with self._lock:
            self._batch.faults.append(fault)

    @property
    def waiting(self) -> int:
        """How many pieces of bytes wait to be written."""
        return len(self._batch.frames)

    @property
    def behind_s(self) -> float:
        """How long ago the last commit ended, in seconds, less what this process was stopped since."""
        return time.monotonic() - self._written_s - self._stopped_s

    def check(self) -> None:
        """Raise `RecordingError` when nothing can be written any more, or the disk cannot keep up."""
        if self._error:
            raise self._error
        now_s = time.monotonic()
        if now_s - self._checked_s > STOPPED_S:  # the loop was away as well: no disk is to blame
            self._stopped_s += now_s - self._checked_s
        self._checked_s = now_s
        if self.behind_s > LONGEST_BACKLOG_S:
            raise RecordingError(
                f"{self._recording.path}: the disk is {self.behind_s:.0f} s behind; record to a faster one. "
                "What was written before is kept"
            )

    def close(self) -> None:
        """Write what is left; raises what `check` raises."""
        self._ended.set()
        self._thread.join(LONGEST_BACKLOG_S)
        self.check()

    def _work(self) -> None:
        last = False
        while not last and not self._error:
            last = self._ended.wait(FLUSH_S)
            with self._lock:
                batch, self._batch = self._batch, Batch()
            try:
                if batch:
                    batch.write(self._recording)
                self._check_file()
            except RecordingError as error:
                self._error = error
            except Exception as error:  # whatever it is: nobody else sees what ends this thread
                self._error = RecordingError(
                    f"{self._recording.path}: cannot be written any more ({type(error).__name__}: {error}). "
                    "What was written before is kept"
                )
            self._written_s, self._stopped_s = time.monotonic(), 0.0
            if not self._error:
                self._snapshots.look()
                self._shorten_log()
        self._snapshots.close()
        if self._shortening:
            self._shortening.join()

    def _shorten_log(self) -> None:
        """Have a long log put into the file by another thread, while this one goes on committing."""
        if self._shortening and self._shortening.is_alive():
            return
        if _bytes(log_of(self._recording.path)) > LONG_LOG:
            self._shortening = threading.Thread(target=self._put_log_away, name="uwblink log", daemon=True)
            self._shortening.start()

    def _put_log_away(self) -> None:
        with suppress(RecordingError):  # what is wrong with the disk, the next commit tells
            self._recording.shorten_log()

    def _check_file(self) -> None:
        """Raise `RecordingError` where the file has no name any more: what is written to it then is lost."""
        path = self._recording.path
        if _identity(path) != self._file:
            raise RecordingError(f"{path}: was removed or replaced while it was being recorded; what it held is lost")


def _bytes(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def _identity(path: Path) -> tuple[int, int] | None:
    """Return what tells a file from another of the same name, None where there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


class _Withdrawn(RecordingError):  # noqa: N818 - nothing is wrong
    """Ends a transaction without a trace."""


def check_writing(recording: Recording) -> None:
    """Raise `RecordingError` unless a row of each kind comes back as it was written; leaves nothing behind.

    `recording` is a new one, with nothing in it. Another version of a library may write otherwise, and an hour later
    is too late to know.
    """
    probe = Batch(
        frames=[FrameRow(1, "probe", "in", bytes(range(256)))],
        exchanges=[(2, 1, RangeReport(2, 1.25, 3, 4, 5, 6, 7, 8, -80.5, -81.5, 0.25, -0.25))],
        cirs=[(3, 1, Cir(1, 2, 3500, (0, 65535, 7)))],
        faults=[Fault(4, "probe", "kind", "a 'detail'", 1, 2)],
    )
    with suppress(_Withdrawn), recording.transaction():
        probe.append_to(recording)
        written, back = map(_values, (exchanges_of(probe.exchanges), recording.exchanges()))
        same = {
            "frames": recording.frames() == probe.frames,
            "exchanges": written == back,
            "cirs": recording.cirs() == [CirRow(3, 1, 1, 2, 3.5, (0, 65535, 7))],
            "faults": recording.faults() == probe.faults,
        }
        if not all(same.values()):
            wrong = ", ".join(table for table, good in same.items() if not good)
            raise RecordingError(f"{recording.path}: what is written comes back otherwise (tables: {wrong})")
        raise _Withdrawn("tried")


def _values(exchanges: Exchanges) -> str:
    return str({name: column.tolist() for name, column in exchanges.to_dict().items()})


def overheard_row(time_ns: int, listener: int, heard: Overheard) -> dict[str, float]:
    """Return a passive listener's report as a row of the table `overheard`."""
    values = {name: getattr(heard, name) for name in Overheard.FIELDS}
    nothing = {name: np.nan for name, value in values.items() if value is None}
    return {"time_ns": time_ns, "listener": listener} | values | nothing
