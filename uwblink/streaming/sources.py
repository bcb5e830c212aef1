"""Where streams come from: boards that range now, or a recording played in its own time."""

from __future__ import annotations

import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from uwblink.boards.listeners import (
    Correction,
    DelayCheck,
    Heard,
    Listener,
    Pair,
    Turn,
    as_listeners,
    check_pairs,
    load_correction,
)
from uwblink.boards.ports import Ports, SerialPorts, wait_until
from uwblink.boards.ranging_plan import RangingPlan
from uwblink.boards.record import identify
from uwblink.boards.recorder import Recorder
from uwblink.errors import ArgumentError
from uwblink.recording.file import Recording
from uwblink.streaming.ranges import StreamedRange, streamed
from uwblink.twr import Exchanges
from uwblink.wire.bulk import exchanges_of
from uwblink.wire.messages import RangeReport

Stream = Generator[StreamedRange, None, None]
AT_A_TIME: Final = 10_000
"""Rows of a recording that are corrected and made into Python's numbers at once."""


def stream(
    source: str | os.PathLike[str] | Iterable[str],
    *,
    calibration: str | os.PathLike[str] | Correction | None = None,
    plan: RangingPlan | None = None,
    duration_s: float = math.inf,
    speed: float = 1.0,
    stop: Callable[[], bool] = lambda: False,
    listeners: Iterable[Listener | Callable[[Heard], object]] = (),
    using: Ports | None = None,
) -> Stream:
    """Yield ranges as they come: of boards at ports, or of a recording in its own time.

    `source` is the path of a recording, or names of ports, on which `plan` is played (every two boards in turns without
    one). `calibration` corrects: a file's path, or a function as `uwblink.boards.load_correction` returns. A recording
    plays `speed` times as fast as it was made; `inf` does not wait at all. `listeners` and `using` are for boards, as
    `uwblink.record` takes them. Whoever takes ranges slowly delays the boards: one loop does both. Raises
    `ArgumentError`, `PlanError` and what `Recording.open` and `Board.open` raise before the first range. Closing the
    iterator closes the ports.

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         '''
    ...         run = { duration_s = 10.0 }
    ...         ranging = { rate_hz = 50 }
    ...         bodies = [
    ...             { name = "near", motion = { model = "static", position_m = [0.0, 0.0, 1.0] } },
    ...             { name = "far", motion = { model = "static", position_m = [3.0, 0.0, 1.0] } },
    ...         ]
    ...         tags = [{ id = 10, body = "near" }, { id = 20, body = "far" }]
    ...         '''
    ...     )
    ... )
    >>> ranges = [one.range_m for one in uwblink.stream(ports.names.values(), duration_s=1.0, using=ports)]
    >>> all(abs(found - 3.0) < 1.0 for found in ranges)
    True
    """
    _positive("duration_s", duration_s)
    _positive("speed", speed)
    correct = _correction(calibration)
    if isinstance(source, str | os.PathLike):
        return _play(_exchanges(Path(source), correct), correct, duration_s, speed, stop)
    chosen, told, ports = plan or RangingPlan(), as_listeners(listeners), using or SerialPorts()
    found = identify(source, ports)
    turns = chosen.turns(sorted(found))

    ranges: deque[StreamedRange] = deque()
    told = [RangeListener(ranges.append, correct), DelayCheck(chosen.programmed(found)), *told]
    for listener in told:
        listener.on_start(turns)
    return _live(lambda: Recorder(found, chosen, turns, told, ports=ports), ranges, duration_s, stop)


def _correction(calibration: str | os.PathLike[str] | Correction | None) -> Correction | None:
    return load_correction(Path(calibration)) if isinstance(calibration, str | os.PathLike) else calibration


def _positive(name: str, value: float) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
        raise ArgumentError(f"found {value!r:.40}, expected a number above 0", parameter=name)


class RangeListener(Listener):
    """A listener of a recorder that calls a function with each range: to record and stream at once.

    >>> import uwblink, uwbsim
    >>> from uwblink.streaming import RangeListener
    >>> ports = uwbsim.VirtualPorts(
    ...     uwbsim.load(
    ...         '''
    ...         run = { duration_s = 10.0 }
    ...         ranging = { rate_hz = 50 }
    ...         bodies = [
    ...             { name = "near", motion = { model = "static", position_m = [0.0, 0.0, 1.0] } },
    ...             { name = "far", motion = { model = "static", position_m = [3.0, 0.0, 1.0] } },
    ...         ]
    ...         tags = [{ id = 10, body = "near" }, { id = 20, body = "far" }]
    ...         '''
    ...     )
    ... )
    >>> ranges = []
    >>> plan, told = uwblink.RangingPlan(rate_hz=20.0), [RangeListener(ranges.append)]
    >>> done = uwblink.record(ports.names.values(), "f.uwb", plan, duration_s=1.0, using=ports, listeners=told)
    >>> len(ranges) == done.exchanges
    True
    """

    def __init__(
        self,
        callback: Callable[[StreamedRange], object],
        calibration: str | os.PathLike[str] | Correction | None = None,
    ) -> None:
        """Call `callback` in the recorder's own loop, so it must be quick; raises what `load_correction` raises."""
        self._callback, self._correct = callback, _correction(calibration)
        self._came_ns: dict[int, int] = {}

    def on_start(self, pairs: Sequence[Pair]) -> None:
        """Raise what the correction raises where it cannot correct ranges of a pair."""
        check_pairs(self._correct, pairs)

    def on_message(self, heard: Heard) -> None:
        """Note when a report came."""
        if isinstance(heard.message, RangeReport):
            self._came_ns[heard.board] = heard.time_ns

    def on_turn(self, turn: Turn) -> None:
        """Call the function with the range of a turn, whose time is that of its poll, as in recordings."""
        if turn.report is not None:
            initiator = turn.pair[0]
            came_ns = self._came_ns.get(initiator, turn.time_ns)
            for found in streamed(exchanges_of([(came_ns, initiator, turn.report)]), self._correct):
                self._callback(found)


def _live(
    begin: Callable[[], Recorder], found: deque[StreamedRange], duration_s: float, stop: Callable[[], bool]
) -> Stream:
    recorder = begin()
    try:
        for _ in recorder.steps(duration_s, stop):
            while found:
                yield found.popleft()
        recorder.finish()
        yield from found
    finally:
        recorder.close()


def _exchanges(path: Path, correct: Correction | None) -> Exchanges:
    with Recording.open(path) as recording:
        if correct and "calibration" in recording.meta():
            raise ArgumentError(f"{path}: its ranges are corrected already; stream it without `calibration`")
        found = recording.exchanges()
    if correct and len(found):  # one of each pair, so that what cannot be corrected is told before the first range
        correct(found[np.unique(np.column_stack([found.initiator, found.target]), axis=0, return_index=True)[1]])
    return found[np.argsort(found.time_ns, kind="stable")]


def _play(
    exchanges: Exchanges, correct: Correction | None, duration_s: float, speed: float, stop: Callable[[], bool]
) -> Stream:
    start_s = time.monotonic()
    first_ns = int(exchanges.time_ns[0]) if len(exchanges) else 0
    for start in range(0, len(exchanges), AT_A_TIME):
        for found in streamed(exchanges[start : start + AT_A_TIME], correct):
            since_s = (found.time_ns - first_ns) * 1e-9
            if since_s > duration_s or not wait_until(start_s + since_s / speed, stop):
                return
            yield found
