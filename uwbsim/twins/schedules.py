"""Who ranged when, how soon boards replied, and which exchanges were lost."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from uwblink.arrays import Bools, Floats, Ints
from uwblink.recording.schema import Fault
from uwblink.ticks import ANTENNA_DELAY_TICKS, TICK_S, UUS_TICKS
from uwblink.twr import intervals
from uwbsim.twins.flight import Flight, lag_one
from uwbsim.units import NS

SHORTEST_LIFE_S: Final = 0.01
"""The shortest life that a scenario can give to paths, fading and outages."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ScheduleFit:
    """When exchanges began, of whom, and which were lost: columns (slots,) in order of time, tags by their places.

    `rate_hz` counts all; `regular` says whether they went round robin, and `turns` in which order. `delay_uus` is the
    scheduled delay, `replies_us` quantiles of replies at once; None where the protocol has none.
    """

    time_s: Floats
    initiator: Ints
    target: Ints
    lost: Bools
    regular: bool
    turns: tuple[tuple[int, int], ...]
    rate_hz: float
    delay_uus: int | None
    replies_us: tuple[float, ...] | None

    @property
    def lost_share(self) -> float:
        """Return the share of exchanges that were lost."""
        return float(np.mean(self.lost))

    def outage_life_s(self) -> float:
        """Return how long a pair's outages last on average, from what is lost next after a loss of the pair."""
        pair = np.minimum(self.initiator, self.target) * 1000 + np.maximum(self.initiator, self.target)
        again = lag_one(self.lost.astype(np.float64), pair)
        if not again > 0.02:
            return SHORTEST_LIFE_S
        order = np.argsort(pair, kind="stable")
        same = pair[order][1:] == pair[order][:-1]
        apart = float(np.median(np.diff(self.time_s[order])[same]))
        return max(-apart / float(np.log(min(again, 0.98))), SHORTEST_LIFE_S)


def fit_schedule(flight: Flight, faults: list[Fault]) -> ScheduleFit:
    """Take the slots of a flight and of the exchanges that failed while it lasted."""
    time, first, second, lost = _slots(flight, faults)
    turns = _turns(first, second)
    regular, rate = False, (len(time) - 1) / max(float(time[-1]), 1e-3)
    if turns:
        regular, beat = _beat(time, first, second, turns)
        if regular:
            # Slots of a round robin that left nothing at all are lost, too.
            rate, slot = 1 / beat, np.rint(time / beat).astype(np.int64)
            every = np.arange(slot[-1] + 1)
            time, lost = every * beat, ~np.isin(every, slot[~lost])
            first, second = np.array(turns)[every % len(turns)].T
    return ScheduleFit(
        time_s=time,
        initiator=first,
        target=second,
        lost=lost,
        regular=regular,
        turns=tuple(turns) if regular else tuple(sorted(set(zip(first.tolist(), second.tolist(), strict=True)))),
        rate_hz=rate,
        delay_uus=_scheduled_uus(flight),
        replies_us=_replies_us(flight),
    )


def _slots(flight: Flight, faults: list[Fault]) -> tuple[Floats, Ints, Ints, Bools]:
    place = {tag.tag: k for k, tag in enumerate(flight.tags)}
    end_ns = int(flight.exchanges.time_ns[-1])
    failed = [
        ((fault.time_ns - flight.origin_ns) * NS, place[fault.initiator], place[fault.target])
        for fault in faults
        if flight.origin_ns <= fault.time_ns <= end_ns and fault.initiator in place and fault.target in place
    ]
    time = np.concatenate([flight.time_s, [row[0] for row in failed]])
    ends = np.concatenate([flight.ends, np.array([row[1:] for row in failed], dtype=np.int64).reshape(-1, 2).T], axis=1)
    lost = np.arange(len(time)) >= len(flight)
    order = np.argsort(time, kind="stable")
    return time[order], ends[0][order], ends[1][order], lost[order]


def _turns(first: Ints, second: Ints) -> list[tuple[int, int]]:
    """Return the order of a round robin, empty where exchanges have none."""
    names = list(zip(first.tolist(), second.tolist(), strict=True))
    followers: dict[tuple[int, int], Counter[tuple[int, int]]] = {}
    for one, other in pairwise(names):
        followers.setdefault(one, Counter())[other] += 1
    turns = [names[0]]
    while len(turns) < len(set(names)):
        after = followers.get(turns[-1], Counter()).most_common(1)
        if not after or after[0][0] in turns:
            return []
        turns.append(after[0][0])
    return turns


def _beat(time: Floats, first: Ints, second: Ints, turns: list[tuple[int, int]]) -> tuple[bool, float]:
    """Return whether slots keep to their turns and to a beat, nine of ten, and its length in seconds."""
    regular_share = 0.9
    number = {pair: k for k, pair in enumerate(turns)}
    turn = np.array([number[pair] for pair in zip(first.tolist(), second.tolist(), strict=True)])
    step, apart = np.diff(turn) % len(turns), np.diff(time)
    in_turn = step == 1 % len(turns)
    if np.mean(in_turn) < regular_share / 2 or not len(apart):
        return False, 0.0
    beat = float(np.median(apart[in_turn]))
    if beat <= 0:
        return False, 0.0
    slots = np.rint(apart / beat)
    beat = float(np.sum(apart) / max(np.sum(slots), 1))
    near = np.abs(apart / beat - np.rint(apart / beat)) < 0.25
    fits = near & (np.rint(apart / beat) % len(turns) == step)
    return bool(np.mean(fits) >= regular_share), beat


def _scheduled_uus(flight: Flight) -> int | None:
    spans = intervals(flight.exchanges)
    shortest, longest = 280, 6500  # what a scenario takes
    for k, message in enumerate(flight.row.messages[1:], start=1):
        if message.timing == "scheduled":
            ticks = float(np.median(spans.dt32 if k == 1 else spans.dt53))
            # A delay is cut to the grid of transmissions, after which the antenna's comes on top.
            nearest = round((ticks - ANTENNA_DELAY_TICKS) / UUS_TICKS)
            return int(np.clip(nearest, shortest, longest))
    return None


def _replies_us(flight: Flight) -> tuple[float, ...] | None:
    if flight.row.messages[1].timing != "at once":
        return None
    delays = intervals(flight.exchanges).dt32 * TICK_S * 1e6
    levels = np.linspace(0, 1, min(201, len(delays)))
    found = np.clip(np.quantile(delays, levels), 180.0, 6000.0)  # what a scenario takes
    return tuple(round(float(value), 4) for value in np.maximum.accumulate(found))
