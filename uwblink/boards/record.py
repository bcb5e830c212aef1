"""Recording from boards into a file: identification of boards, metadata, and the thread that writes the file."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Final

import numpy as np

from uwblink.boards.board import Board
from uwblink.boards.listeners import DelayCheck, Heard, Listener, Pair, Progress, WrongDelayError, as_listeners
from uwblink.boards.ports import Closing, Ports, SerialPorts
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.recorder import Recorder
from uwblink.database import log_of
from uwblink.errors import PlanError, RecordingError
from uwblink.output import check_output
from uwblink.recording.antenna_delays import meta_of_delays
from uwblink.recording.file import Recording
from uwblink.recording.schema import SHAPES, Arrangement, CirRow, Fault, FrameRow, Tag
from uwblink.wire.codec import exchanges_of
from uwblink.wire.messages import Cir, Overheard

LONGEST_BACKLOG_S: Final = 20.0
"""Longest tolerated delay of the disk; busy disks need a second or two."""

LONG_LOG: Final = 8 * 2**20
"""Half of the size at which DuckDB checkpoints its log within a commit, which takes a second on a busy machine."""


def record(  # noqa: PLR0913 - the settings of a recording, by keyword
    ports: Iterable[str],
    output: str | os.PathLike[str],
    plan: RangingPlan,
    *,
    duration_s: float = float("inf"),
    passive: bool = False,
    arrangement: str | None = None,
    known: str = "",
    order: Sequence[int] = (),
    force: bool = False,
    stop: Callable[[], bool] = lambda: False,
    watch: Callable[[Progress], None] | None = None,
    listeners: Iterable[Listener | Callable[[Heard], object]] = (),
    using: Ports | None = None,
) -> Progress:
    """Record from boards until `stop` returns true or the time is over; returns the counts.

    `ports` are names or pyserial URLs, `watch` is called four times a second, `listeners` are called with everything
    that the file gets (see `uwblink.boards.listeners`), and `using` are ports other than this computer's serial ports
    (`VirtualPorts`). `arrangement` is a name for the places of boards that stand still, for a survey; `known` states
    that they are on a "line" or a "plane", and `order` is the order of their ids along the line. The antenna delays of
    `plan` are stored in the recording. `KeyboardInterrupt` ends a recording like `stop`, with everything in the file.
    Raises the errors of `Board.open`, `PlanError` (a tag of plan or order is absent, two boards have the same id, an
    invalid duration, or stamps with other antenna delays than the plan's, whose recording is removed), and
    `RecordingError` (cannot be written, disk full); the file stays readable.

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(uwbsim.load("two_boards_on_a_bench/bench"))
    >>> plan = uwblink.RangingPlan(rate_hz=20.0)
    >>> done = uwblink.record(ports.names.values(), "flight.uwb", plan, duration_s=1.0, using=ports)
    >>> len(uwblink.load("flight.uwb").exchanges) == done.exchanges > 15
    True
    """
    if not duration_s > 0:
        raise PlanError(f"duration_s: found {duration_s!r}, expected more than 0 seconds")
    path, others, using = Path(output), as_listeners(listeners), using or SerialPorts()
    mark = Arrangement(arrangement or "", 0, 0, known, tuple(order))
    check_output(path, force=force, recording=True)
    found = identify(ports, using)
    turns, delays = plan.turns(sorted(found)), plan.programmed(found)
    _check_boards(found, plan, mark)
    for listener in others:
        listener.on_start(turns)
    meta = _meta(found, plan, turns, passive) | (meta_of_delays(delays) if plan.antenna_delays else {})
    try:
        # Without a limit of memory DuckDB would cache the whole file.
        with Recording.create(path, meta=meta, force=force, live=True, memory_mb=64) as recording:
            placed = {tag.tag: tag for tag in plan.tags}
            recording.append("tags", [placed.get(b, Tag(b, f"tag{b}", (0.0, 0.0, 0.0))) for b in sorted(found)])
            with RecordingWriter(recording) as writer:
                listening = [writer, DelayCheck(delays), *others]

                def report(progress: Progress) -> None:
                    progress.waiting, progress.behind_s = writer.waiting, writer.behind_s
                    if watch:
                        watch(progress)

                with Recorder(found, plan, turns, listening, passive=passive, ports=using) as recorder:
                    recorder.run(duration_s, stop, report)
            if arrangement:
                first_ns = recorder.progress.start_ns
                mark = replace(mark, start_ns=first_ns, end_ns=max(using.host_ns(), first_ns + 1))
                recording.append("arrangements", [mark])
    except WrongDelayError:
        path.unlink(missing_ok=True)  # its `meta` would contain wrong antenna delays
        raise
    return recorder.progress


def _check_boards(found: Mapping[int, str], plan: RangingPlan, mark: Arrangement) -> None:
    """Raise `PlanError` for an impossible arrangement, and for an order or places of tags of absent boards."""
    if mark.known not in SHAPES or (mark.known and not mark.name):
        raise PlanError(
            f"found {mark.known!r:.40}, allowed: line, plane, and only for an `arrangement` with a name",
            parameter="known",
        )
    if mark.order and mark.known != "line":
        raise PlanError("needs boards that are `known` to be on a line", parameter="order")
    there, placed = ", ".join(map(str, sorted(found))), {tag.tag for tag in plan.tags}
    if mark.order and sorted(mark.order) != sorted(found):
        raise PlanError(
            f"found {', '.join(map(str, mark.order))}, expected each of the boards at the ports, {there}",
            parameter="order",
        )
    if placed and not placed & found.keys():
        named = ", ".join(map(str, sorted(placed)))
        raise PlanError(
            f"the plan has positions of the tags {named}, but the boards at the ports are {there}; check the plan"
        )


def _meta(found: Mapping[int, str], plan: RangingPlan, turns: Iterable[Pair], passive: bool) -> dict[str, Any]:
    played = {name: getattr(plan, name) for name in ("rate_hz", "protocol", "target_reports", "get_cir")}
    return {
        "source": "boards",
        "ports": {str(board): name for board, name in sorted(found.items())},
        "plan": {"pairs": [list(pair) for pair in turns], **played, "passive": passive},
    }


def identify(names: Iterable[str], ports: Ports) -> dict[int, str]:
    """Return the port of each board by id; raises `PlanError` if two have one id, and what `Board.open` raises."""
    found: dict[int, str] = {}
    for name in names:
        with Board(ports.open(name)) as board:
            number = board.id
        if number in found:
            raise PlanError(f"{found[number]} and {name} both have the id {number}; ids must differ")
        found[number] = name
    return found


Row = FrameRow | Fault | Heard
"""Tables of a recording for messages of boards."""


def append_rows(recording: Recording, rows: Sequence[Row]) -> None:
    """Append rows to their tables; raises `RecordingError`.

    Messages other than reports of exchanges, overheard exchanges and impulse responses are stored as bytes only.
    """

    heard = [(row.time_ns, row.board, row.message) for row in rows if isinstance(row, Heard)]
    recording.append("frames", [row for row in rows if isinstance(row, FrameRow)])
    recording.append("faults", [row for row in rows if isinstance(row, Fault)])
    recording.append("exchanges", exchanges_of(heard))
    recording.append("overheard", [overheard_row(t, board, o) for t, board, o in heard if isinstance(o, Overheard)])
    cirs = [
        CirRow(t, board, c.initiator, c.target, c.first_path_milli / 1000, c.magnitudes)
        for t, board, c in heard
        if isinstance(c, Cir)
    ]
    recording.append("cirs", cirs)


def overheard_row(time_ns: int, listener: int, heard: Overheard) -> dict[str, Any]:
    """Return the row of the table `overheard` of a message; missing values are NaN."""
    values = ((name, getattr(heard, name)) for name in Overheard.FIELDS)
    return {"time_ns": time_ns, "listener": listener} | {n: np.nan if v is None else v for n, v in values}


class RecordingWriter(Closing, Listener):
    """A listener that writes a live recording. A context manager: leaving it writes the remaining rows.

    A thread commits every 0.1 s, so that a slow disk does not make the recorder miss bytes; a power cut loses no more
    than this time. `behind_s` is the time since the last commit, without the time for which this process was stopped.
    """

    def __init__(self, recording: Recording) -> None:
        """Start writing."""
        self._recording = recording
        self._rows: SimpleQueue[Row] = SimpleQueue()
        self._ended = threading.Event()
        self.behind_s, self._checked_s = 0.0, time.monotonic()
        self._file = recording.path.stat()
        self._error: RecordingError | None = None
        self._thread = threading.Thread(target=self._work, name="uwblink writer", daemon=True)
        self._thread.start()

    def on_bytes(self, time_ns: int, port: str, direction: str, data: bytes) -> None:
        """Keep bytes."""
        self._rows.put(FrameRow(time_ns, port, direction, data))

    def on_message(self, heard: Heard) -> None:
        """Keep a message."""
        self._rows.put(heard)

    def on_fault(self, fault: Fault) -> None:
        """Keep a fault."""
        self._rows.put(fault)

    @property
    def waiting(self) -> int:
        """Number of rows that are not written yet."""
        return self._rows.qsize()

    def check(self) -> None:
        """Raise `RecordingError` if writing has failed, or the disk is too slow."""
        if self._error:
            raise self._error
        now_s = time.monotonic()
        # If the loop did not check for two seconds, the process was stopped (Ctrl-Z, a suspended computer).
        self.behind_s += min(now_s - self._checked_s, 2.0)
        self._checked_s = now_s
        if self.behind_s > LONGEST_BACKLOG_S:
            raise RecordingError(
                f"{self._recording.path}: writing to the disk is {self.behind_s:.0f} s late; record to a faster "
                f"disk. Data written before are kept"
            )

    def close(self) -> None:
        """Write the rest; raises what `check` raises."""
        self._ended.set()
        self._thread.join(LONGEST_BACKLOG_S)
        self.check()

    def _work(self) -> None:
        path = self._recording.path
        shortening: Future[None] | None = None
        # Another thread checkpoints a long log, while this one continues to commit.
        with ThreadPoolExecutor(1, "uwblink log") as other:
            while not self._error:
                last = self._ended.wait(0.1)
                try:
                    self._write()
                    with suppress(OSError):  # there is no log
                        if log_of(path).stat().st_size > LONG_LOG and (shortening is None or shortening.done()):
                            shortening = other.submit(self._recording.shorten_log)
                except RecordingError as error:
                    self._error = error
                except Exception as error:  # otherwise it would end the thread silently
                    self._error = RecordingError(
                        f"{path}: cannot be written any more ({type(error).__name__}: {error}). "
                        "What was written before is kept"
                    )
                if last:
                    break

    def _write(self) -> None:
        """Commit the waiting rows; raises `RecordingError` if the file was removed or replaced."""
        path = self._recording.path
        if rows := [self._rows.get() for _ in range(self._rows.qsize())]:
            with self._recording.transaction():
                append_rows(self._recording, rows)
        self.behind_s = 0.0
        with suppress(OSError):
            if os.path.samestat(path.stat(), self._file):
                return
        raise RecordingError(f"{path}: was removed or replaced during the recording; its contents are lost")
