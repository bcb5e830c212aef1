"""Listeners of a recorder, among them those that count exchanges and check antenna delays.

```python
import uwblink

def print_range(heard: uwblink.Heard) -> None:
    print(heard.board, heard.message)

uwblink.record(["/dev/ttyACM0", "/dev/ttyACM1"], "flight.uwb", uwblink.RangingPlan(), listeners=[print_range])
```

A listener is a function of one `Heard`, or an object of a class derived from `Listener`: the writer of the file, the
live table and the user's callback are all listeners. They are called in the recorder's own loop, in their order, so
they must be quick: at most 0.1 ms for a message. Slower work belongs in a thread of the listener, as in the file
writer. An exception of a listener ends the recording; the file keeps everything before.

Ranges are corrected by other distributions, because uwblink does not import packages that depend on it. An entry point
of the group `uwbcal.corrections` names a function that takes the path of a calibration and returns a `Correction`, or a
function that corrects exchanges.
"""

from __future__ import annotations

import os
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import entry_points
from pathlib import Path

from uwblink.corrections import Columns, Correction
from uwblink.errors import PlanError, restating
from uwblink.recording.antenna_delays import AntennaDelays, delays_differ
from uwblink.recording.schema import Fault
from uwblink.recording.summary import counted
from uwblink.ticks import DELAYED_TX_GRID
from uwblink.twr import STAMPS, Exchanges
from uwblink.wire.codec import Event
from uwblink.wire.messages import Cir, Overheard, RangeReport, TargetRangeReport

Pair = tuple[int, int]
"""Initiator and target."""


@dataclass(frozen=True, slots=True)
class Heard:
    """A message or a line of text that a board sent, the id of the board, and when it came (host time, Unix epoch).

    Every function among the listeners of `uwblink.record` is called with these:

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(uwbsim.load("two_boards_on_a_bench/bench"))
    >>> heard = []
    >>> plan = uwblink.RangingPlan(rate_hz=20.0)
    >>> _ = uwblink.record(
    ...     ports.names.values(), "heard.uwb", plan, duration_s=1.0, using=ports, listeners=[heard.append]
    ... )
    >>> {one.board for one in heard if type(one.message).__name__ == "RangeReport"}
    {10}
    """

    time_ns: int
    board: int
    message: Event


@dataclass(frozen=True, slots=True)
class Turn:
    """One turn of the plan: when its report came, its pair, and the report, None if the exchange failed."""

    time_ns: int
    pair: Pair
    report: RangeReport | None


class Listener:
    """Base of listeners: override the methods that you need; by default they do nothing.

    >>> import uwblink, uwbsim
    >>> ports = uwbsim.VirtualPorts(uwbsim.load("two_boards_on_a_bench/bench"))
    >>> class Farthest(uwblink.Listener):
    ...     range_m = 0.0
    ...
    ...     def on_turn(self, turn):
    ...         if turn.report:
    ...             self.range_m = max(self.range_m, turn.report.range_m)
    >>> farthest, plan = Farthest(), uwblink.RangingPlan(rate_hz=20.0)
    >>> _ = uwblink.record(
    ...     ports.names.values(), "far.uwb", plan, duration_s=1.0, using=ports, listeners=[farthest]
    ... )
    >>> abs(farthest.range_m - 3.0) < 0.5
    True
    """

    def on_start(self, pairs: Sequence[Pair]) -> None:
        """Called with the pairs that will range; an exception here ends the recording before anything is written."""

    def on_bytes(self, time_ns: int, port: str, direction: str, data: bytes) -> None:
        """Called with bytes that came "in" from a port or went "out" to it."""

    def on_message(self, heard: Heard) -> None:
        """Called with a message or a line of text of a board."""

    def on_turn(self, turn: Turn) -> None:
        """Called with the result of a turn of the plan."""

    def on_fault(self, fault: Fault) -> None:
        """Called with a fault."""

    def check(self) -> None:
        """Raise an exception to end the recording; called often."""


class CallbackListener(Listener):
    """Calls a function with every message of boards."""

    def __init__(self, callback: Callable[[Heard], object]) -> None:
        """Call `callback` with each `Heard`; raises `TypeError` for other objects than functions."""
        if not callable(callback):
            raise TypeError(f"listeners: found {callback!r}, expected a Listener or a function of one Heard")
        self._callback = callback

    def on_message(self, heard: Heard) -> None:
        """Call the function."""
        self._callback(heard)


def as_listeners(listeners: Iterable[Listener | Callable[[Heard], object]]) -> list[Listener]:
    """Return listeners, and functions as listeners; raises `TypeError` for other objects."""
    return [one if isinstance(one, Listener) else CallbackListener(one) for one in listeners]


@dataclass(slots=True)
class PairState:
    """Counts of a pair, and the last reports of its exchanges, each with its host time (ns) and initiator.

    `recent` has the end times of its turns, and whether there was a report.
    """

    tried: int = 0
    good: int = 0
    recent: deque[tuple[int, bool]] = field(default_factory=lambda: deque(maxlen=1000))
    reports: deque[tuple[int, int, RangeReport]] = field(default_factory=lambda: deque(maxlen=1000))


@dataclass(slots=True, kw_only=True)
class Progress(Listener):
    """Counts of a recording. Times are in seconds since `start_ns` (host time).

    `absent` has the host time at which each absent board was unplugged. `waiting` is the number of pieces of bytes that
    are not in the file yet; its last commit ended `behind_s` seconds ago.
    """

    start_ns: int = 0
    time_s: float = 0.0
    pairs: dict[Pair, PairState] = field(default_factory=dict)
    faults: Counter[str] = field(default_factory=Counter)
    last_faults: deque[Fault] = field(default_factory=lambda: deque(maxlen=8))
    absent: dict[str, int] = field(default_factory=dict)
    overheard: int = 0
    cirs: int = 0
    waiting: int = 0
    behind_s: float = 0.0

    @property
    def exchanges(self) -> int:
        """Number of successful exchanges."""
        return sum(p.good for p in self.pairs.values())

    @property
    def tried(self) -> int:
        """Number of exchanges that have ended, failed ones included."""
        return sum(p.tried for p in self.pairs.values())

    @property
    def last_fault(self) -> str:
        """Kind and detail of the last fault, "" without one."""
        return "".join(f"{fault.kind}: {fault.detail}" for fault in [*self.last_faults][-1:])

    def rows(self) -> list[tuple[Pair, list[str]]]:
        """Return each pair's rate (Hz, over 2 s), success (over 10 s), last range (m) and its power (dBm) as texts."""
        now_ns = self.start_ns + self.time_s * 1e9
        since_ns, over_s = now_ns - 2e9, min(2.0, max(self.time_s, 0.1))
        rows = []
        for pair, state in [*self.pairs.items()]:
            reports = [
                *state.reports
            ]  # copied in one step: a page reads in its own thread while the recorder continues
            rate_hz = sum(time_ns > since_ns for time_ns, *_ in reports) / over_s
            ended = [good for time_ns, good in [*state.recent] if time_ns > now_ns - 10e9]
            success = f"{100 * sum(ended) / len(ended):.0f} %" if ended and state.tried else ""
            last = [
                (f"{report.range_m:.3f}", f"{report.fpp1_dbm:.1f}".replace("nan", "")) for *_, report in reports[-1:]
            ]
            rows.append((pair, [f"{rate_hz:.1f}", success, *(last or [("", "")])[0]]))
        return rows

    def __str__(self) -> str:
        """Return the counts as one line."""
        others = {"overheard": self.overheard, "impulse responses": self.cirs}
        counts = "".join(f", {count} {name}" for name, count in others.items() if count)
        return (
            f"{self.exchanges} of {self.tried} exchanges in {self.time_s:.1f} s{counts}; faults: {self.fault_counts()}"
        )

    def fault_counts(self) -> str:
        """Return the number of faults of each kind as text."""
        return counted(dict(sorted(self.faults.items())))

    def on_message(self, heard: Heard) -> None:
        """Count messages without a turn of their own."""
        self.overheard += isinstance(heard.message, Overheard)
        self.cirs += isinstance(heard.message, Cir)

    def on_turn(self, turn: Turn) -> None:
        """Count a turn of a pair."""
        state = self.pairs.setdefault(turn.pair, PairState())
        state.tried += 1
        state.recent.append((turn.time_ns, turn.report is not None))
        if turn.report is not None:
            state.good += 1
            state.reports.append((turn.time_ns, turn.pair[0], turn.report))

    def on_fault(self, fault: Fault) -> None:
        """Count a fault."""
        self.faults[fault.kind] += 1
        self.last_faults.append(fault)
        if fault.kind == "unplugged":
            self.absent.setdefault(fault.board, fault.time_ns)
        elif fault.kind == "replugged":
            self.absent.pop(fault.board, None)


class WrongDelayError(PlanError):
    """Boards have other antenna delays than the given ones."""


class DelayCheck(Listener):
    """Raises `WrongDelayError` if the stamps of a board contradict its given antenna delay.

    Frames are sent on a grid of 512 ticks, and their stamp is this time plus the antenna delay, so stamp and delay have
    the same remainder. Stamps do not show the receive delay.
    """

    def __init__(self, delays: AntennaDelays) -> None:
        """Check stamps against the programmed `delays` of boards."""
        self._expected = {
            (board, name): getattr(delay, name) for board, delay in delays.items() for name in ("tx", "reply")
        }
        self._rests: dict[tuple[int | None, str], deque[int]] = {}

    def on_turn(self, turn: Turn) -> None:
        """Check the stamps of a report; a confirmed delay is not checked again."""
        report = turn.report
        if report is None or not self._expected:
            return
        initiator, target = turn.pair
        double_sided = bool(report.tx3 or report.rx3)
        sent = {(initiator, "tx"): report.tx1, (target, "tx" if double_sided else "reply"): report.tx2}
        if double_sided:
            sent[target, "reply"] = report.tx3
        for which, stamp in [(which, stamp) for which, stamp in sent.items() if which in self._expected]:
            delay, half = self._expected[which], DELAYED_TX_GRID // 2
            rest = (stamp - delay + half) % DELAYED_TX_GRID - half
            rests = self._rests.setdefault(which, deque(maxlen=3))
            rests.append(rest)
            if not rest:
                del self._expected[which]
            # Three reports must contradict a delay in the same way: the wire has no checksum, and one stamp may be
            # damaged.
            elif len(rests) == 3 and len(set(rests)) == 1:
                board, name = which
                raise WrongDelayError(
                    f"board {board}: {name} = {delay} was given, but by its stamps it is {delay + rest}; give the "
                    f"delays that are programmed into the boards",
                    parameter="antenna_delays",
                )


class ReportCheck:
    """Compares each report with the last report of the other board of its pair."""

    def __init__(self) -> None:
        """Start without reports."""
        self._last: dict[Pair, tuple[int, RangeReport]] = {}

    def add(self, board: int, report: RangeReport) -> str | None:
        """Add a report; returns its differences from the report of the other board, None without any."""
        pair = (report.neighbour, board) if isinstance(report, TargetRangeReport) else (board, report.neighbour)
        before = self._last.pop(pair, None)
        # Two reports of different exchanges have equal stamps only by chance.
        same = before and any(getattr(before[1], name) == getattr(report, name) != 0 for name in STAMPS)
        if before is None or before[0] == board or not same:
            self._last[pair] = board, report
            return None
        both = ((n, getattr(before[1], n), getattr(report, n)) for n in RangeReport.FIELDS if n != "neighbour")
        differences = ", ".join(f"{name} {one} and {other}" for name, one, other in both if one != other)
        whose = f"boards {before[0]} and {board} report one exchange of {pair[0]} with {pair[1]} differently"
        return f"{whose}: {differences}" if differences else None


CorrectionSource = str | os.PathLike[str] | Correction | Callable[[Exchanges], Columns]
"""A calibration file, or a correction as an object or a function."""


def load_correction(source: CorrectionSource) -> Correction:
    """Return a correction unchanged, or the correction of a calibration file.

    Raises `PlanError`, also if no installed distribution has a correction, or if loading the file raises it.
    """
    if not isinstance(source, str | os.PathLike):
        return source if isinstance(source, Correction) else Correction(source)
    path, found = Path(source), sorted(entry_points(group="uwbcal.corrections"), key=lambda entry: entry.name)
    if not found:
        raise PlanError(f"{path}: no installed distribution corrects ranges (entry points of uwbcal.corrections)")
    kinds = (ValueError, OSError, ImportError)
    translated = restating(PlanError, *kinds)
    with restating(PlanError, *kinds):
        known = load_correction(found[0].load()(path))
    differences = known.differences and translated(known.differences)
    return replace(known, ranges=translated(known.ranges), differences=differences)


def delays_warning(correct: Correction | None, delays: AntennaDelays, tags: Iterable[int] | None = None) -> str:
    """Return a warning if a correction is for other antenna delays than the programmed ones; "" if not, or if unknown.

    `tags` are the ranging tags, by default all tags of the correction.
    """
    then: AntennaDelays = correct.antenna_delays if correct else {}
    return delays_differ(then, delays, (tag for tag in then if tag is not None) if tags is None else tags)


def check_pairs(correct: Callable[[Exchanges], Columns] | None, pairs: Sequence[tuple[int, int]]) -> None:
    """Correct one range of each pair, so that the correction raises its error for impossible pairs."""
    if correct and pairs:
        initiator, target = zip(*pairs, strict=True)
        correct(Exchanges.from_arrays(initiator, target, tx1=[0] * len(pairs), rx1=0, tx2=0, rx2=0, range_m=1.0))
