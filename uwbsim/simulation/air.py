"""The plan of a scenario, and its execution by discrete events: transmissions, collisions, lost messages.

A host commands its boards one after the other. With the plan "round-robin" one host commands all boards; with any other
plan each initiator has a host of its own, and only the plan keeps two boards from transmitting at the same time.

The event loop decides which messages are received, and when. It uses nominal delays, which differ from the exact ones
by a few tens of nanoseconds; no decision depends on that. `timestamps` computes the exact instants afterwards.

A frame is registered before it is sent, and its reception is decided when it ends: by then all frames that overlap it
are registered. Each message is one event. An exchange whose messages are all above the sensitivity, and which ends
before any other host can begin one, is a single event.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import simpy

from uwblink.arrays import ArrayRows, Bools, Floats, Ints
from uwblink.protocols.table import RangingProtocol
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.scenario.radio import Radio
from uwbsim.scenario.ranging import (
    PREAMBLE_TIMEOUT_S,
    RECEIVER_ON_S,
    TURNAROUND_S,
    after_marker_s,
    before_marker_s,
    broadcast_s,
    message_bytes,
)
from uwbsim.world.clocks import SUBTICKS_PER_SECOND
from uwbsim.world.reception import Medium


@dataclass(frozen=True, slots=True)
class Schedule(ArrayRows):
    """Planned exchanges (n,): true start in sub-ticks, indices of the tags, and the host that commands each."""

    start: Ints
    initiator: Ints
    target: Ints
    host: Ints


def schedule(scenario: Scenario) -> Schedule:
    """Return the exchanges that a scenario plans, in order of time; a broadcast is one row for each listener."""
    place = {tag.id: k for k, tag in enumerate(scenario.tags)}
    plan, rate_hz, duration_s = scenario.ranging.plan, scenario.ranging.rate_hz, scenario.run.duration_s
    if not isinstance(plan, str):
        slots = [slot for slot in plan.slots if slot[0] <= duration_s]
        turns = np.array([[place[a], place[b]] for _, a, b in slots], dtype=np.int64)
        return _in_order(np.array([time_s for time_s, _, _ in slots]), turns, turns[:, 0])
    turn = scenario.pairs() if plan != "broadcast" else [(a, a) for a in scenario.senders()]
    pairs = np.array([[place[a], place[b]] for a, b in turn], dtype=np.int64)
    if plan == "aloha":
        # Every initiator ranges at random times with random targets; their rates add up to the plan's.
        initiators, parts = np.unique(pairs[:, 0]), []
        for initiator in initiators:
            rng = stream(scenario.run.seed, "aloha", scenario.tags[initiator].id)
            times = np.sort(rng.uniform(0, duration_s, rng.poisson(rate_hz / len(initiators) * duration_s)))
            mine = pairs[pairs[:, 0] == initiator]
            parts.append((times, mine[rng.integers(0, len(mine), len(times))]))
        start, turns = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        return _in_order(start, turns, turns[:, 0])
    # The pairs range in turn. With "tdma" each initiator has a host of its own, whose clock has an error of
    # `sync_error_ms`. With "common-list" each robot begins after the exchange before its own, which keeps the order; if
    # it cannot hear that exchange, it waits for `list_timeout_ms` in addition (`Slots.pause`).
    count = int(duration_s * rate_hz)
    start, turns = np.arange(count) / rate_hz, pairs[np.arange(count) % len(pairs)]
    if plan not in ("tdma", "broadcast"):
        return _in_order(start, turns, np.zeros(count, dtype=np.int64))
    # With "broadcast" the tags keep their slots by the frames that they hear, with another error each time.
    rng, which = stream(scenario.run.seed, "sync error"), np.arange(count) if plan == "broadcast" else turns[:, 0]
    late = rng.normal(size=max(count, len(place))) * (scenario.ranging.sync_error_ms * 1e-3)
    found = _in_order(np.maximum(start + late[which], 0), turns, turns[:, 0])
    return _to_all_others(found, len(place)) if plan == "broadcast" else found


def _to_all_others(sent: Schedule, tags: int) -> Schedule:
    """Return broadcasts with a row for each other tag; the rows of a frame follow each other."""
    listeners = (sent.initiator[:, None] + np.arange(1, tags)) % tags
    return replace(sent[np.repeat(np.arange(len(sent.start)), tags - 1)], target=listeners.ravel())


def _in_order(start_s: Floats, pairs: Ints, host: Ints) -> Schedule:
    order = np.argsort(start_s, kind="stable")
    start = (start_s * SUBTICKS_PER_SECOND).astype(np.int64)
    return Schedule(start, pairs[:, 0], pairs[:, 1], host)[order]


WEAK, COLLIDED, BUSY, FOREIGN, LATE = "below sensitivity", "collision", "receiver busy", "another's frame", "too late"

Steps = Generator[simpy.Event, Any, None]
Powers = Callable[[int, int], Floats]
"""Returns the power in dBm at every tag from a sender, at a true time in sub-ticks."""


@dataclass(frozen=True, slots=True)
class Slots:
    """A plan of n exchanges, and the nominal outcome of each message.

    `pause` (n,) are sub-ticks for which the initiator waits first; `heard` (messages, n) says whether a message is
    above the receiver's sensitivity; `delay` (messages, n) are the sub-ticks from the stamp that a message waits for
    until its departure.
    """

    plan: Schedule
    pause: Ints
    heard: Bools
    delay: Ints


@dataclass(slots=True)
class Outcomes:
    """Outcomes of n exchanges: departure of the poll, index of the lost message (-1: none), and the reason."""

    start: list[int]
    lost: list[int]
    reason: list[str]


@dataclass(frozen=True, slots=True)
class _Frame:
    start: int
    end: int
    sender: int
    exchange: int


class Air:
    """The medium and the radios that use it while a plan is executed."""

    def __init__(self, protocol: RangingProtocol, slots: Slots, powers: Powers, radio: Radio) -> None:
        """Begin at time zero with no frame on the medium."""
        self.env = simpy.Environment()
        self._messages, self._slots, self._powers, self._radio = protocol.messages, slots, powers, radio
        self._start, self._pause = slots.plan.start.tolist(), slots.pause.tolist()
        self._ends: list[list[int]] = np.column_stack([slots.plan.initiator, slots.plan.target]).tolist()
        self._before = _subticks(before_marker_s(radio.preamble_symbols))
        self._after = [_subticks(after_marker_s(n)) for n in message_bytes(protocol)]
        self._timeout = _subticks(PREAMBLE_TIMEOUT_S + RECEIVER_ON_S)
        self._turnaround = _subticks(TURNAROUND_S)
        self._frames: list[_Frame] = []
        self._busy_until = dict.fromkeys(itertools.chain(*self._ends), 0)
        self._next_begin: dict[int, int] = {}
        self._lengths = self._undisturbed_lengths()
        self._completed, count = itertools.count(1), len(self._start)
        self.outcomes = Outcomes([-1] * count, [-1] * count, [""] * count)

    def execute(self, progress: Callable[[float], None] | None = None) -> Outcomes:
        """Execute the plans of all hosts; `progress` is called with the completed share of all exchanges."""
        hosts = self._slots.plan.host
        self._next_begin = dict.fromkeys(np.unique(hosts).tolist(), 0)
        processes = [
            self.env.process(self._host(host, np.flatnonzero(hosts == host).tolist(), progress))
            for host in self._next_begin
        ]
        self.env.run(until=self.env.all_of(processes))
        return self.outcomes

    def _host(self, host: int, numbers: list[int], progress: Callable[[float], None] | None) -> Steps:
        """Execute the exchanges of one host, one after the other."""
        env, next_begin, never = self.env, self._next_begin, 1 << 62
        for number in numbers:
            begin = max(next_begin[host], self._start[number])
            next_begin[host] = begin
            if begin > env.now:
                yield env.timeout(begin - int(env.now))
            next_begin[host] = never
            if self._alone(number, begin):
                self.outcomes.start[number] = begin + self._before
                # All later exchanges begin after it, so its boards need no entry in `_busy_until`.
                end = begin + self._lengths[number]
            else:
                next_begin[host] = 0
                if self._pause[number]:
                    yield env.timeout(self._pause[number])
                yield from self._exchange(number)
                end = int(env.now)
            next_begin[host] = end + self._turnaround
            completed = next(self._completed)
            if progress and not completed % 500:
                progress(completed / len(self._start))
        next_begin[host] = never

    def _undisturbed_lengths(self) -> list[int]:
        """Return the duration of each exchange without disturbance, (n,); -1 if that must be found step by step."""
        slots, after = self._slots, np.array(self._after)[:, None]
        waits = slots.delay[1:] - self._before - after[:-1]
        plain = slots.heard.all(axis=0) & (slots.pause == 0) & (waits <= self._timeout).all(axis=0)
        length = self._before + slots.delay[1:].sum(axis=0) + self._after[-1]
        lengths: list[int] = np.where(plain, length, -1).tolist()
        return lengths

    def _alone(self, number: int, begin: int) -> bool:
        """Return whether an exchange that begins now ends before any other event."""
        length, (initiator, target) = self._lengths[number], self._ends[number]
        return (
            length >= 0
            and min(self._next_begin.values()) > begin + length
            and self._busy_until[initiator] <= begin
            and self._busy_until[target] <= begin
        )

    def _exchange(self, number: int) -> Steps:
        """Send the messages of an exchange in turn; stop at a lost one, after the wait for it."""
        env, outcomes, delays = self.env, self.outcomes, self._slots.delay[:, number].tolist()
        busy, (initiator, target) = self._busy_until, self._ends[number]
        if busy[initiator] > env.now:  # a board that answers another board executes its own command afterwards
            yield env.timeout(busy[initiator] - int(env.now))
        marker = int(env.now) + self._before
        outcomes.start[number] = listening_since = marker
        for k, message in enumerate(self._messages):
            if k:
                marker += delays[k]
            sender, receiver = (initiator, target) if message.sender == "initiator" else (target, initiator)
            frame = _Frame(marker - self._before, marker + self._after[k], sender, number)
            self._frames.append(frame)
            yield env.timeout(frame.end - int(env.now))
            reason = self._loss(k, frame, receiver, listening_since)
            if reason:
                outcomes.lost[number], outcomes.reason[number] = k, reason
                # The board that waits for the lost message gives up at the preamble timeout.
                busy[initiator] = max(listening_since + self._timeout, int(env.now))
                yield env.timeout(busy[initiator] - int(env.now))
                return
            listening_since = frame.end
            if not k:
                # Both boards are in this exchange now; the target sends its last frame even if others are lost.
                busy[initiator] = busy[target] = marker + sum(delays[1:]) + self._after[-1]

    def _loss(self, k: int, frame: _Frame, receiver: int, since: int) -> str:
        """Return why the receiver, which listens since an instant, lost a frame that has just ended; empty if not."""
        if not self._slots.heard[k, frame.exchange]:
            return WEAK
        if k and frame.start - since > self._timeout:
            return LATE
        if not k and self._busy_until[receiver] > frame.start:
            return BUSY
        self._frames = [other for other in self._frames if other.end > int(self.env.now) - 2 * self._timeout]
        earliest = min(since, frame.start) if k else frame.start
        others = [
            other
            for other in self._frames
            if other.exchange != frame.exchange and other.end > earliest and other.start < frame.end
        ]
        for other in others:
            if other.sender == receiver:
                return BUSY
            power = float(self._powers(other.sender, other.start)[receiver])
            if power < self._radio.sensitivity_dbm:
                continue
            if other.end > frame.start:
                signal = float(self._powers(frame.sender, frame.start)[receiver])
                if self._radio.loses(signal, frame.start, power, other.start):
                    return COLLIDED
            elif k and other.start >= since:
                return FOREIGN  # a board that waits for an answer receives the first frame that arrives
        return ""


def with_collisions_of_broadcasts(medium: Medium, plan: Schedule, alone: Outcomes) -> Outcomes:
    """Return outcomes of broadcasts with the losses by overlap: a collision, or a listener that sends itself.

    The rows of a frame follow each other. Slots depend on nothing that is received: there is no event loop.
    """
    scenario = medium.scenario
    radio, listeners = scenario.radio, len(scenario.tags) - 1
    begin = plan.start[::listeners]
    duration = broadcast_s(len(scenario.senders()), radio.preamble_symbols) * SUBTICKS_PER_SECOND
    if not (np.diff(begin) < duration).any():
        return alone
    # A sender's own frame is stronger than any that it could receive.
    power, frame = np.full((len(begin), listeners + 1), np.inf), np.arange(len(plan.start)) // listeners
    power[frame, plan.target] = medium.links.link(plan.initiator, plan.target, plan.start).power_dbm
    why, apart = np.full(power.shape, "", dtype=object), 1
    while len(first := np.flatnonzero(begin[apart:] - begin[:-apart] < duration)):
        for mine, other in ((first, first + apart), (first + apart, first)):
            lost = radio.loses(power[mine], begin[mine, None], power[other], begin[other, None])
            why[mine] = np.where(lost, np.where(np.isinf(power[other]), BUSY, COLLIDED), why[mine])
        apart += 1
    reason = [own or other for own, other in zip(alone.reason, why[frame, plan.target].tolist(), strict=True)]
    return Outcomes(alone.start, [0 if text else -1 for text in reason], reason)


def _subticks(seconds: float) -> int:
    return round(seconds * SUBTICKS_PER_SECOND)
