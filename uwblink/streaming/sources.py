"""Streams of ranges, optionally corrected: from boards, or from a recording in real time."""

from __future__ import annotations

import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from heapq import merge
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from uwblink.boards.dialects import Dialect, printed_ranges
from uwblink.boards.listeners import (
    CorrectionSource,
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
from uwblink.boards.record import identify, overheard_row
from uwblink.boards.recorder import Recorder
from uwblink.corrections import Correction
from uwblink.errors import ArgumentError
from uwblink.receptions import exchange_of
from uwblink.recording.file import Recording
from uwblink.twr import Exchanges
from uwblink.wire.codec import exchanges_of
from uwblink.wire.messages import Overheard

Stream = Generator["StreamedRange | StreamedDifference", None, None]


class Streamed:
    """Base of what a stream yields."""

    __slots__ = ()

    def to_dict(self) -> dict[str, Any]:
        """Return the known values by name; numbers that are not finite are left out, because JSON has none."""
        own: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}  # type: ignore[arg-type]
        more = own.pop("more", {})
        return {name: value for name, value in (own | dict(more)).items() if math.isfinite(value)}

    def to_json(self) -> str:
        """Return the same as one line of JSON, without its end."""
        return json.dumps(self.to_dict(), allow_nan=False)


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamedDifference(Streamed):
    """A difference of arrival in metres: the distance from a listener to the target minus that to the initiator.

    `difference_m` is by stamps alone, `corrected_m` and its standard deviation `sigma_m` with a calibration. The
    covariance of two differences of one exchange is `shared_m` squared. They are not correlated with the range of the
    exchange.
    """

    time_ns: int
    initiator: int
    target: int
    listener: int
    difference_m: float
    corrected_m: float
    sigma_m: float
    shared_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamedRange(Streamed):
    """A range in metres, the time of its exchange (host time, Unix epoch), and its pair.

    `range_m` is the reported range. `corrected_m` and its standard deviation `sigma_m` are NaN without a
    calibration, and for tags that are not calibrated; `more` are other columns of the correction, such as
    `sigma_total_m`, which includes reflections and unknown directions.

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


def streamed(exchanges: Exchanges, correct: Correction | None) -> Iterator[StreamedRange]:
    """Yield exchanges as ranges of a stream, corrected where there is a correction."""
    names = [one.name for one in fields(StreamedRange) if hasattr(exchanges, one.name)]
    known = {name: column.tolist() for name, column in (correct(exchanges) if correct else {}).items()}
    own = {name: known.pop(name) for name in ("corrected_m", "sigma_m") if name in known}
    columns = {name: getattr(exchanges, name).tolist() for name in names} | own
    for row in range(len(exchanges)):
        more = {name: column[row] for name, column in known.items()}
        yield StreamedRange(more=more, **{name: column[row] for name, column in columns.items()})


def streamed_differences(
    exchanges: Exchanges, overheard: Mapping[str, NDArray[Any]], correct: Correction | None
) -> Iterator[StreamedDifference]:
    """Yield what tags overheard of exchanges, by columns of the table `overheard`, corrected."""
    columns = correct.differences(exchanges, overheard) if correct and correct.differences else {}
    for row in zip(*(column.tolist() for column in columns.values()), strict=True):
        yield StreamedDifference(**dict(zip(columns, row, strict=True)))


def _check_use(use: str, correct: Correction | None) -> bool:
    """Return whether differences of arrival are streamed; raises `ArgumentError` where nothing corrects them."""
    if use not in ("exchanges", "receptions"):
        raise ArgumentError(f"found {use!r:.40}, allowed: exchanges, receptions", parameter="use")
    if use == "receptions" and not (correct and correct.differences):
        raise ArgumentError(
            "receptions need a `calibration` that corrects them: one with delays and without patterns over direction",
            parameter="use",
        )
    return use == "receptions"


def stream(  # noqa: PLR0913 - options by name
    source: str | os.PathLike[str] | Iterable[str],
    *,
    calibration: CorrectionSource | None = None,
    use: str = "exchanges",
    plan: RangingPlan | None = None,
    duration_s: float = math.inf,
    speed: float = 1.0,
    stop: Callable[[], bool] = lambda: False,
    listeners: Iterable[Listener | Callable[[Heard], object]] = (),
    using: Ports | None = None,
) -> Stream:
    """Yield ranges as they are measured by boards, or as they were measured in a recording.

    `source` is the path of a recording, or names of ports, on which `plan` is played (every two boards in turns without
    one). `calibration` corrects: a file's path, or a function as `uwblink.boards.load_correction` returns. With `use`
    "receptions" boards listen, too, and differences of arrival (`StreamedDifference`) follow the range of an exchange
    that was overheard. A recording plays `speed` times as fast as it was made; `inf` does not wait. `listeners` and
    `using` are for boards, as in `uwblink.record`. A slow consumer of the ranges delays the boards, because one loop
    does both. Raises `ArgumentError`, `PlanError` and what `Recording.open` and `Board.open` raise before the first
    range. Closing the iterator closes the ports.

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(uwbsim.load("two_boards_on_a_bench/bench"))
    >>> ranges = [one.range_m for one in uwblink.stream(ports.names.values(), duration_s=1.0, using=ports)]
    >>> all(abs(found - 3.0) < 1.0 for found in ranges)
    True
    """
    for name, value in (("duration_s", duration_s), ("speed", speed)):
        if isinstance(value, bool) or not isinstance(value, int | float) or not value > 0:
            raise ArgumentError(f"found {value!r:.40}, expected a number above 0", parameter=name)
    correct = None if calibration is None else load_correction(calibration)
    if isinstance(source, str | os.PathLike):
        recorded = _recorded(Path(source), correct, listening=_check_use(use, correct))
        return _play(*recorded, correct, duration_s, speed, stop)
    chosen, ports = plan or RangingPlan(), using or SerialPorts()
    found = identify(source, ports)
    turns = chosen.turns(sorted(found))
    ranges: deque[StreamedRange | StreamedDifference] = deque()
    listening = [
        RangeListener(ranges.append, correct, use),
        DelayCheck(chosen.programmed(found)),
        *as_listeners(listeners),
    ]
    for listener in listening:
        listener.on_start(turns)

    def live() -> Stream:
        with Recorder(found, chosen, turns, listening, passive=use == "receptions", ports=ports) as recorder:
            for _ in recorder.steps(duration_s, stop):
                while ranges:
                    yield ranges.popleft()
            recorder.finish()
            yield from ranges

    return live()


def stream_printed(
    ports: Iterable[str],
    dialect: Dialect,
    *,
    calibration: CorrectionSource | None = None,
    **how: Any,
) -> Stream:
    """Yield ranges that boards of other firmware print, corrected with a calibration.

    `how` are other parameters of `uwblink.boards.printed_ranges`, which raises.
    """
    correct = None if calibration is None else load_correction(calibration)
    for turns in printed_ranges(ports, dialect, **how):
        yield from streamed(
            exchanges_of((one.time_ns, one.pair[0], one.report) for one in turns if one.report), correct
        )


class RangeListener(Listener):
    """A listener of a recorder that calls a function with each range: to record and stream at once.

    >>> import uwblink, uwbsim
    >>> from uwblink.streaming import RangeListener
    >>> ports = uwbsim.VirtualPorts(uwbsim.load("two_boards_on_a_bench/bench"))
    >>> ranges = []
    >>> plan, told = uwblink.RangingPlan(rate_hz=20.0), [RangeListener(ranges.append)]
    >>> done = uwblink.record(ports.names.values(), "f.uwb", plan, duration_s=1.0, using=ports, listeners=told)
    >>> len(ranges) == done.exchanges
    True
    """

    def __init__(
        self,
        callback: Callable[[Any], object],
        calibration: CorrectionSource | None = None,
        use: str = "exchanges",
    ) -> None:
        """Call `callback` in the recorder's own loop, so it must be quick; raises what `load_correction` raises.

        With `use` "receptions" also with each `StreamedDifference` of boards that listen.
        """
        self._callback, self._correct = callback, None if calibration is None else load_correction(calibration)
        self._last: Exchanges | None = None
        # Boards that overhear may print before the one that reports; those of a few exchanges are kept.
        self._overheard = deque[dict[str, Any]](maxlen=100 * _check_use(use, self._correct))

    def on_start(self, pairs: Sequence[Pair]) -> None:
        """Raise what the correction raises where it cannot correct ranges of a pair."""
        check_pairs(self._correct, pairs)

    def on_message(self, heard: Heard) -> None:
        """Call the function with the difference of arrival, if the exchange is the last one."""
        if isinstance(heard.message, Overheard):
            self._overheard.append(overheard_row(heard.time_ns, heard.board, heard.message))
            self._tell_differences()

    def on_turn(self, turn: Turn) -> None:
        """Call the function with the range of a turn, whose time is that of its poll, as in recordings."""
        if turn.report is not None:
            self._last = exchanges_of([(turn.time_ns, turn.pair[0], turn.report)])
            for found in streamed(self._last, self._correct):
                self._callback(found)
            self._tell_differences()

    def _tell_differences(self) -> None:
        """Call the function with what boards overheard of the last exchange."""
        last = self._last
        if last is None:
            return
        own = [row for row in self._overheard if (row["rx1_n"], row["tx2_n"]) == (int(last.rx1[0]), int(last.tx2[0]))]
        for row in own:
            self._overheard.remove(row)
            columns = {name: np.array([value]) for name, value in row.items()}
            for found in streamed_differences(last, columns, self._correct):
                self._callback(found)


def _recorded(path: Path, correct: Correction | None, *, listening: bool) -> tuple[Exchanges, dict[str, NDArray[Any]]]:
    with Recording.open(path) as recording:
        if correct and "calibration" in recording.meta():
            raise ArgumentError(f"{path}: its ranges are already corrected; stream it without `calibration`")
        if (differences := recording.count("differences")) and not recording.count("exchanges"):
            raise ArgumentError(f"{path}: contains {differences} differences of arrival, but no ranges to stream")
        found, heard = recording.exchanges(), recording.columns("overheard") if listening else {}
    if listening and not len(heard["time_ns"]):
        raise ArgumentError(f"{path}: nothing was overheard; record with passive boards", parameter="use")
    if correct and len(found):  # one range of each pair, so that errors come before the first range
        correct(found[np.unique(np.column_stack([found.initiator, found.target]), axis=0, return_index=True)[1]])
    return found.in_time_order(), heard


def _play(
    exchanges: Exchanges,
    overheard: Mapping[str, NDArray[Any]],
    correct: Correction | None,
    duration_s: float,
    speed: float,
    stop: Callable[[], bool],
) -> Stream:
    start_s = time.monotonic()
    first_ns = int(exchanges.time_ns[0]) if len(exchanges) else 0
    row = exchange_of(exchanges, overheard) if overheard else np.zeros(0, dtype=np.int64)
    # In blocks, because Python numbers take ten times the memory.
    for start in range(0, len(exchanges), 10_000):
        some, own = exchanges[start : start + 10_000], np.flatnonzero((row >= start) & (row < start + 10_000))
        columns = {name: column[own[np.argsort(row[own])]] for name, column in overheard.items()}
        kinds: list[Iterable[Any]] = [streamed(some, correct)]
        kinds += [streamed_differences(some, columns, correct)] if len(own) else []
        for found in merge(*kinds, key=attrgetter("time_ns")):
            since_s = (found.time_ns - first_ns) * 1e-9
            if since_s > duration_s or not wait_until(start_s + since_s / speed, stop):
                return
            yield found
