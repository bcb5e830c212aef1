"""Reading a recording that another process is still writing: by snapshots, made by its writer when somebody asks.

DuckDB lets one process have a file. So whoever finds a recording in use puts a request beside it, an empty hidden
file; the writer copies what it has committed into a file beside the request, on a second connection of its own, so
that recording goes on meanwhile; and the reader opens that and deletes its name. Nothing is left behind.
"""

from __future__ import annotations

import os
import shutil
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final, TypeVar
from uuid import uuid4

from uwblink.errors import RecordingError, RecordingInUseError
from uwblink.output import PARTIAL, place_beside

WANTED: Final = ".wanted"
BEGUN: Final = ".partial-begun"
READY: Final = ".snapshot"
PATIENCE_S: Final = 30.0
LOOK_EVERY_S: Final = 0.02
ANSWERED_WITHIN_S: Final = 2.0
"""A writer looks for requests ten times a second; one that does not take a request up in this time makes none."""

Opened = TypeVar("Opened")


class SnapshotMaker:
    """The writer's side: makes a snapshot for every request, in a thread of its own.

    `make(place)` writes what is committed to a new file; it may raise `RecordingError`, and the reader is told nothing
    but that there is no snapshot.
    """

    def __init__(self, recording: Path, make: Callable[[Path], None]) -> None:
        """Answer requests for a recording."""
        self._recording, self._make = recording, make
        self._thread: threading.Thread | None = None
        _sweep(recording)

    def look(self) -> None:
        """Take up requests, unless the ones before are still being worked on; cheap enough for ten times a second."""
        if self._thread is not None and self._thread.is_alive():
            return
        wanted = _beside(self._recording, WANTED)
        if wanted:
            self._thread = threading.Thread(target=self._answer, args=(wanted,), name="uwblink snapshot", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Let the snapshot that is being made be finished."""
        if self._thread is not None:
            self._thread.join(PATIENCE_S)

    def _answer(self, wanted: list[Path]) -> None:
        for request in wanted:
            begun = request.with_suffix(BEGUN)
            with suppress(OSError, RecordingError):
                request.rename(begun)  # the reader sees that somebody works on it
                with place_beside(self._recording) as place:
                    self._make(place)
                    place.rename(request.with_suffix(READY))
            begun.unlink(missing_ok=True)


def open_snapshot(recording: Path, reopen: Callable[[Path], Opened]) -> Opened:
    """Ask a recording's writer for a snapshot, and open it; the recording itself, if its writer ends meanwhile.

    Raises `RecordingInUseError` where the writer makes none (another program, an older version), the folder cannot be
    written, or the disk is full.
    """
    request = recording.with_name(f".{recording.name}.{uuid4().hex}{WANTED}")
    ready, begun = request.with_suffix(READY), request.with_suffix(BEGUN)
    try:
        request.touch()
    except OSError as error:
        raise _in_use(recording, f"no request can be put beside it: {error.strerror}") from error
    asked_s = time.monotonic()
    try:
        while time.monotonic() < asked_s + PATIENCE_S:
            if ready.exists():
                return reopen(ready)
            if not request.exists() and not begun.exists() and not ready.exists():
                break  # taken up, and given up
            if request.exists() and time.monotonic() > asked_s + ANSWERED_WITHIN_S:
                break
            time.sleep(LOOK_EVERY_S)
            try:
                return reopen(recording)
            except RecordingInUseError:
                continue
        raise _in_use(recording, "it makes no snapshots")
    finally:
        request.unlink(missing_ok=True)
        ready.unlink(missing_ok=True)


def _in_use(recording: Path, why: str) -> RecordingInUseError:
    return RecordingInUseError(f"{recording}: another process is writing it, and {why}; wait until that ends")


def _beside(recording: Path, kind: str) -> list[Path]:
    """Return the hidden files of a kind that belong to a recording."""
    start = f".{recording.name}."
    folder = recording.parent
    return [folder / name for name in os.listdir(folder) if name.startswith(start) and name.endswith(kind)]


def _sweep(recording: Path) -> None:
    """Remove what processes that were killed have left."""
    for kind in (WANTED, BEGUN, READY, PARTIAL):
        for left in _beside(recording, kind):
            if left.is_dir() and not left.is_symlink():
                shutil.rmtree(left, ignore_errors=True)
            else:
                left.unlink(missing_ok=True)
