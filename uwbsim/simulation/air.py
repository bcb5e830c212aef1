"""The plans of a scenario, and the discrete-event loop that executes them: transmissions, collisions, failures.

A host commands boards one after the other. In a round robin one host commands all; otherwise every initiator has its
own, and only the plan keeps two from sending at once.

The loop decides what happens and in which order. It runs on nominal delays, within a few tens of nanoseconds of the
exact instants, on which nothing in it depends; those are computed afterwards in batches (`timestamps`).

A frame is noted when it is decided to send it and judged when it has ended, so that every frame which overlaps it is
known by then: one event a message. An exchange whose messages are all heard, and which is over before any other host
can begin, is one event.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import simpy

from uwblink.arrays import Bools, Floats, Ints
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
    message_bytes,
)
from uwbsim.world.clocks import SUBTICKS_PER_SECOND


@dataclass(frozen=True, slots=True)
class Schedule:
    """Planned exchanges as columns (n,): true start in sub-ticks, places of the tags, and the host that plays each."""

    start: Ints
    initiator: Ints
    target: Ints
    host: Ints

    def hosts(self) -> list[list[int]]:
        """Return the numbers of the exchanges that each host plays, in order."""
        return [np.flatnonzero(self.host == host).tolist() for host in np.unique(self.host)]


def schedule(scenario: Scenario) -> Schedule:
    """Return the exchanges that a scenario plans."""
    place = {tag.id: k for k, tag in enumerate(scenario.tags)}
    if not isinstance(scenario.ranging.plan, str):
        rows = [slot for slot in scenario.ranging.plan.slots if slot[0] <= scenario.run.duration_s]
        start, ids = np.array([r[0] for r in rows]), [(int(r[1]), int(r[2])) for r in rows]
        pairs = np.array([[place[a], place[b]] for a, b in ids], dtype=np.int64)
        return _schedule(start, pairs, pairs[:, 0])
    pairs = np.array([[place[a], place[b]] for a, b in scenario.pairs()], dtype=np.int64)
    if scenario.ranging.plan == "aloha":
        return _aloha(scenario, pairs)
    # In turns, at the rate. One host plays them; with tdma each initiator has its own, whose clock is off by
    # `sync_error_ms`. With a common list each robot begins when it has heard the exchange before its own, which keeps
    # the order; who is too far away to hear it waits for `list_timeout_ms` more (`Slots.pause`).
    count = int(scenario.run.duration_s * scenario.ranging.rate_hz)
    start, turn = np.arange(count) / scenario.ranging.rate_hz, pairs[np.arange(count) % len(pairs)]
    if scenario.ranging.plan != "tdma":
        return _schedule(start, turn, np.zeros(count, dtype=np.int64))
    error_s = stream(scenario.run.seed, "sync error").normal(size=len(scenario.tags))
    late = error_s * (scenario.ranging.sync_error_ms * 1e-3)
    return _schedule(np.maximum(start + late[turn[:, 0]], 0), turn, turn[:, 0])


def _aloha(scenario: Scenario, pairs: Ints) -> Schedule:
    """Return exchanges of every initiator at random times with random targets; their rates add up to the plan's."""
    initiators = np.unique(pairs[:, 0])
    duration, rate = scenario.run.duration_s, scenario.ranging.rate_hz / len(initiators)
    parts = []
    for number in initiators:
        rng = stream(scenario.run.seed, "aloha", scenario.tags[number].id)
        times = np.sort(rng.uniform(0, duration, rng.poisson(rate * duration)))
        mine = pairs[pairs[:, 0] == number]
        parts.append((times, mine[rng.integers(0, len(mine), len(times))]))
    start = np.concatenate([times for times, _ in parts])
    turn = np.concatenate([chosen for _, chosen in parts])
    return _schedule(start, turn, turn[:, 0])


def _schedule(start_s: Floats, pairs: Ints, host: Ints) -> Schedule:
    order = np.argsort(start_s, kind="stable")
    start = (start_s[order] * SUBTICKS_PER_SECOND).astype(np.int64)
    return Schedule(start, pairs[order, 0], pairs[order, 1], host[order])


WEAK, COLLIDED, BUSY, FOREIGN, LATE = "below sensitivity", "collision", "receiver busy", "another's frame", "too late"

Steps = Generator[simpy.Event, Any, None]
Powers = Callable[[int, int], Floats]
"""Returns the power (dBm) at every tag from a sender, at a true time in sub-ticks."""


@dataclass(frozen=True, slots=True)
class Slots:
    """A plan of n exchanges as columns: when, who, and what the radios will make of each message.

    `pause` is what the initiator waits first, in sub-ticks; `heard` (messages, n) says whether a message is above the
    receiver's sensitivity, `delay` (messages, n) is the sub-ticks from the stamp it waits for until it leaves.
    """

    start: list[int]
    initiator: list[int]
    target: list[int]
    pause: list[int]
    heard: Bools
    delay: Ints


@dataclass(slots=True)
class Outcomes:
    """The outcome of each slot: when its poll left (-1: never), the lost message (-1: none), and the reason."""

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
    """The medium and the radios on it, while the slots of a plan are played."""

    def __init__(
        self, protocol: RangingProtocol, slots: Slots, tags: int, hosts: int, powers: Powers, radio: Radio
    ) -> None:
        """Begin at time zero with no frame on the air.

        `tags` is the number of radios and `hosts` that of those who command them; `powers` gives what each radio hears
        of a sender.
        """
        self.env = simpy.Environment()
        self._messages, self._slots = protocol.messages, slots
        self._powers, self._radio = powers, radio
        self._before = _subticks(before_marker_s(radio.preamble_symbols))
        self._after = [_subticks(after_marker_s(n)) for n in message_bytes(protocol)]
        self._patience = _subticks(PREAMBLE_TIMEOUT_S + RECEIVER_ON_S)
        self._turnaround = _subticks(TURNAROUND_S)
        self._frames: list[_Frame] = []
        self._busy_until = [0] * tags
        self._soonest = [0] * hosts
        self._played = 0
        self._lengths = self._undisturbed()
        self.outcomes = Outcomes([-1] * len(slots.start), [-1] * len(slots.start), [""] * len(slots.start))

    def play(self, host: int, numbers: Sequence[int], progress: Callable[[float], None] | None = None) -> Steps:
        """Play the slots of one host, one after the other; `progress` is called with the done share of all slots."""
        env, slots, soonest, never = self.env, self._slots, self._soonest, 1 << 62
        for number in numbers:
            begin = max(soonest[host], slots.start[number])
            soonest[host] = begin
            if begin > env.now:
                yield env.timeout(begin - int(env.now))
            soonest[host] = never
            if self._alone(number, begin):
                end = self._succeed(number, begin)
            else:
                soonest[host] = 0
                if slots.pause[number]:
                    yield env.timeout(slots.pause[number])
                yield from self._exchange(number)
                end = int(env.now)
            soonest[host] = end + self._turnaround
            self._played += 1
            if progress and not self._played % 500:
                progress(self._played / len(slots.start))
        soonest[host] = never

    def _undisturbed(self) -> list[int]:
        """Return how long each exchange takes if nothing disturbs it, n; -1 for those that are to be looked at."""
        slots, after = self._slots, np.array(self._after)[:, None]
        waits = slots.delay[1:] - self._before - after[:-1]
        plain = slots.heard.all(axis=0) & (np.array(slots.pause) == 0) & (waits <= self._patience).all(axis=0)
        length = self._before + slots.delay[1:].sum(axis=0) + self._after[-1]
        lengths: list[int] = np.where(plain, length, -1).tolist()
        return lengths

    def _alone(self, number: int, begin: int) -> bool:
        """Return whether an exchange that begins now ends before any other event."""
        length, busy = self._lengths[number], self._busy_until
        return (
            length >= 0
            and min(self._soonest) > begin + length
            and busy[self._slots.initiator[number]] <= begin
            and busy[self._slots.target[number]] <= begin
        )

    def _succeed(self, number: int, begin: int) -> int:
        """Record an undisturbed exchange; return the end of its last frame."""
        self.outcomes.start[number] = begin + self._before
        end = begin + self._lengths[number]
        self._busy_until[self._slots.initiator[number]] = self._busy_until[self._slots.target[number]] = end
        return end

    def _exchange(self, number: int) -> Steps:
        """Send the messages of an exchange in turn; stop, after the wait for it, at one that is not received."""
        env, outcomes, delays = self.env, self.outcomes, self._slots.delay[:, number].tolist()
        busy, me, other = self._busy_until, self._slots.initiator[number], self._slots.target[number]
        if busy[me] > env.now:  # a board that answers somebody takes its own command when it is done
            yield env.timeout(busy[me] - int(env.now))
        marker = int(env.now) + self._before
        outcomes.start[number] = marker
        listening_since = marker
        for k, message in enumerate(self._messages):
            if k:
                marker += delays[k]
            sender, receiver = (me, other) if message.sender == "initiator" else (other, me)
            frame = _Frame(marker - self._before, marker + self._after[k], sender, number)
            self._frames.append(frame)
            yield env.timeout(frame.end - int(env.now))
            reason = self._fate(k, frame, receiver, listening_since, marker)
            if reason:
                outcomes.lost[number], outcomes.reason[number] = k, reason
                # Whoever waits for the missing message gives up when its preamble does not come.
                until = listening_since + self._patience
                busy[me] = max(until, int(env.now))
                yield env.timeout(max(until - int(env.now), 0))
                return
            listening_since = frame.end
            if not k:
                # From now on both are in this exchange; the target will send its last frame whatever becomes of others.
                busy[me] = busy[other] = marker + sum(delays[1:]) + self._after[-1]

    def _fate(self, k: int, frame: _Frame, receiver: int, since: int, marker: int) -> str:
        """Return why a frame that has just ended was not received, empty if it was."""
        if not self._slots.heard[k, frame.exchange]:
            return WEAK
        if k and frame.start - since > self._patience:
            return LATE
        if not k and self._busy_until[receiver] > frame.start:
            return BUSY
        if len(self._frames) > 1:
            return self._interference(k, frame, receiver, since)
        self._frames.clear()
        return ""

    def _interference(self, k: int, frame: _Frame, receiver: int, since: int) -> str:
        """Return whether another frame on the air collides with one, or is received in its place; empty if not."""
        now = int(self.env.now)
        oldest = now - 2 * self._patience
        self._frames = [f for f in self._frames if f.end > oldest]
        earliest = min(since, frame.start) if k else frame.start
        others = [f for f in self._frames if f.exchange != frame.exchange and f.end > earliest and f.start < frame.end]
        if not others:
            return ""
        signal = float(self._powers(frame.sender, frame.start)[receiver])
        for f in others:
            if f.sender == receiver:
                return BUSY
            power = float(self._powers(f.sender, f.start)[receiver])
            if power < self._radio.sensitivity_dbm:
                continue
            if f.end <= frame.start:
                if k and f.start >= since:
                    return FOREIGN  # a board that waits for an answer takes the first frame that comes
                continue
            captured = signal >= power + self._radio.capture_db and frame.start <= f.start
            if not captured:
                return COLLIDED
        return ""


def run(
    protocol: RangingProtocol,
    slots: Slots,
    hosts: Sequence[Sequence[int]],
    tags: int,
    powers: Powers,
    radio: Radio,
    progress: Callable[[float], None] | None = None,
) -> Outcomes:
    """Play a plan; `hosts` are the numbers of each host's slots, in order. Returns what became of every slot."""
    air = Air(protocol, slots, tags, len(hosts), powers, radio)
    processes = [air.env.process(air.play(host, numbers, progress)) for host, numbers in enumerate(hosts)]
    air.env.run(until=air.env.all_of(processes))
    return air.outcomes


def _subticks(seconds: float) -> int:
    return round(seconds * SUBTICKS_PER_SECOND)
