"""What a recorder has done so far: by pair, by kind of fault, by board."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from uwblink.boards.listeners import Heard, Listener, Pair, Turn
from uwblink.recording.schema import Fault
from uwblink.wire.messages import Cir, Overheard

RATE_WINDOW_S: Final = 2.0


@dataclass(slots=True)
class PairState:
    """How a pair has done so far; `recent_s` are the times of its last successes, since the start."""

    tried: int = 0
    good: int = 0
    range_m: float = float("nan")
    fpp_dbm: float = float("nan")
    recent_s: deque[float] = field(default_factory=lambda: deque(maxlen=1000))

    def rate_hz(self, time_s: float) -> float:
        """Return the successes a second over the last two seconds before `time_s`."""
        # Of a copy, made at once: a page asks in a thread of its own, while the recorder goes on.
        recent = sum(t > time_s - RATE_WINDOW_S for t in [*self.recent_s])
        return recent / min(RATE_WINDOW_S, max(time_s, 0.1))


@dataclass(slots=True, kw_only=True)
class Progress(Listener):
    """Counts for whoever watches. Times in seconds since `start_ns` (host time).

    `waiting` pieces of bytes are not in the file yet, whose last commit ended `behind_s` seconds ago.
    """

    start_ns: int = 0
    time_s: float = 0.0
    pairs: dict[Pair, PairState] = field(default_factory=dict)
    faults: dict[str, int] = field(default_factory=dict)
    last_fault: str = ""
    overheard: int = 0
    cirs: int = 0
    waiting: int = 0
    behind_s: float = 0.0

    @property
    def exchanges(self) -> int:
        """Exchanges that succeeded."""
        return sum(p.good for p in self.pairs.values())

    @property
    def tried(self) -> int:
        """Exchanges that were begun and ended."""
        return sum(p.tried for p in self.pairs.values())

    def on_message(self, heard: Heard) -> None:
        """Count what has no turn of its own."""
        self.overheard += isinstance(heard.message, Overheard)
        self.cirs += isinstance(heard.message, Cir)

    def on_turn(self, turn: Turn) -> None:
        """Count a turn of a pair."""
        state = self.pairs.setdefault(turn.pair, PairState())
        state.tried += 1
        if turn.report is not None:
            state.good += 1
            state.range_m, state.fpp_dbm = turn.report.range_m, turn.report.fpp1_dbm
            state.recent_s.append((turn.time_ns - self.start_ns) * 1e-9)

    def on_fault(self, fault: Fault) -> None:
        """Count a fault."""
        self.faults[fault.kind] = self.faults.get(fault.kind, 0) + 1
        self.last_fault = f"{fault.kind}: {fault.detail}"
