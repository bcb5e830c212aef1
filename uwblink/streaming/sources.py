"""Streams of ranges, optionally corrected: from boards, or from a recording in real time."""

from __future__ import annotations

import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from uwblink.boards.dialects import Dialect, printed_ranges
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
from uwblink.twr import Exchanges
from uwblink.wire.codec import exchanges_of
from uwblink.wire.messages import RangeReport

Stream = Generator["StreamedRange", None, None]


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamedRange:
    """A range in metres, the time of its exchange (host time, Unix epoch), and its pair.

    `range_m` is the reported range. `corrected_m` and its standard deviation `sigma_m` are NaN without a
    calibration, and for tags that are not calibrated; `more` are other columns of the correction, such as `clamped`.

    >>> import uwblink
    >>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    >>> uwblink.Contents(exchanges=x).save("mine.uwb")
    >>> [round(one.range_m, 2) for one in uwblink.stream("mine.uwb", speed=100.0)]
    [4.69]
    """

    time_ns: int
    initiator: int
    target: int
    range_m: float
    corrected_m: float = math.nan
    sigma_m: float = math.nan
    fpp1_dbm: float
    fpp2_dbm: float
    skew1_ppm: float
    skew2_ppm: float
    more: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the known values by name; numbers that are not finite are left out, because JSON has none."""
        own = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "more"}
        return {name: value for name, value in (own | dict(self.more)).items() if math.isfinite(value)}

    def to_json(self) -> str:
        """Return the same as one line of JSON, without its end."""
        return json.dumps(self.to_dict(), allow_nan=False)


def streamed(exchanges: Exchanges, correct: Correction | None) -> Iterator[StreamedRange]:
    """Yield exchanges as ranges of a stream, corrected where there is a correction."""
    names = [one.name for one in fields(StreamedRange) if hasattr(exchanges, one.name)]
    known = {name: column.tolist() for name, column in (correct(exchanges) if correct else {}).items()}
    own = {name: known.pop(name) for name in ("corrected_m", "sigma_m") if name in known}
    columns = {name: getattr(exchanges, name).tolist() for name in names} | own
    for row in range(len(exchanges)):
        more = {name: column[row] for name, column in known.items()}
        yield StreamedRange(more=more, **{name: column[row] for name, column in columns.items()})


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
    """Yield ranges as they are measured by boards, or as they were measured in a recording.

    `source` is the path of a recording, or names of ports, on which `plan` is played (every two boards in turns without
    one). `calibration` corrects: a file's path, or a function as `uwblink.boards.load_correction` returns. A recording
    plays `speed` times as fast as it was made; `inf` does not wait. `listeners` and `using` are for boards, as
    in `uwblink.record`. A slow consumer of the ranges delays the boards, because one loop does both. Raises
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
    for name, value in (("duration_s", duration_s), ("speed", speed)):
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ArgumentError(f"found {value!r:.40}, expected a number above 0", parameter=name)
    correct = _correction(calibration)
    if isinstance(source, str | os.PathLike):
        return _play(_exchanges(Path(source), correct), correct, duration_s, speed, stop)
    chosen, ports = plan or RangingPlan(), using or SerialPorts()
    found = identify(source, ports)
    turns = chosen.turns(sorted(found))
    ranges: deque[StreamedRange] = deque()
    listening = [RangeListener(ranges.append, correct), DelayCheck(chosen.programmed(found)), *as_listeners(listeners)]
    for listener in listening:
        listener.on_start(turns)

    def live() -> Stream:
        recorder = Recorder(found, chosen, turns, listening, ports=ports)
        try:
            for _ in recorder.steps(duration_s, stop):
                while ranges:
                    yield ranges.popleft()
            recorder.finish()
            yield from ranges
        finally:
            recorder.close()

    return live()


def stream_printed(
    ports: Iterable[str],
    dialect: Dialect,
    *,
    calibration: str | os.PathLike[str] | Correction | None = None,
    **how: Any,
) -> Stream:
    """Yield ranges that boards of other firmware print, corrected with a calibration.

    `how` are other parameters of `uwblink.boards.printed_ranges`, which raises.
    """
    correct = _correction(calibration)
    for turns in printed_ranges(ports, dialect, **how):
        yield from streamed(
            exchanges_of((one.time_ns, one.pair[0], one.report) for one in turns if one.report), correct
        )


def _correction(calibration: str | os.PathLike[str] | Correction | None) -> Correction | None:
    return load_correction(Path(calibration)) if isinstance(calibration, str | os.PathLike) else calibration


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
        """Store the time of a report."""
        if isinstance(heard.message, RangeReport):
            self._came_ns[heard.board] = heard.time_ns

    def on_turn(self, turn: Turn) -> None:
        """Call the function with the range of a turn, whose time is that of its poll, as in recordings."""
        if turn.report is not None:
            initiator = turn.pair[0]
            came_ns = self._came_ns.get(initiator, turn.time_ns)
            for found in streamed(exchanges_of([(came_ns, initiator, turn.report)]), self._correct):
                self._callback(found)


def _exchanges(path: Path, correct: Correction | None) -> Exchanges:
    with Recording.open(path) as recording:
        if correct and "calibration" in recording.meta():
            raise ArgumentError(f"{path}: its ranges are corrected already; stream it without `calibration`")
        found = recording.exchanges()
    if correct and len(found):  # one range of each pair, so that errors come before the first range
        correct(found[np.unique(np.column_stack([found.initiator, found.target]), axis=0, return_index=True)[1]])
    return found.in_time_order()


def _play(
    exchanges: Exchanges, correct: Correction | None, duration_s: float, speed: float, stop: Callable[[], bool]
) -> Stream:
    start_s = time.monotonic()
    first_ns = int(exchanges.time_ns[0]) if len(exchanges) else 0
    # In blocks, because Python numbers take ten times the memory.
    for start in range(0, len(exchanges), 10_000):
        for found in streamed(exchanges[start : start + 10_000], correct):
            since_s = (found.time_ns - first_ns) * 1e-9
            if since_s > duration_s or not wait_until(start_s + since_s / speed, stop):
                return
            yield found
