"""The discrete-event loop: tags that send, wait and answer, and the air between them.

The loop decides what happens and in which order: which frames arrive, which exchanges fail, when the
next one can start. It runs on nominal delays, within a few tens of nanoseconds of the exact instants,
on which nothing in it depends; those are computed afterwards in batches (`uwbsim.stamps`).
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import Any, Final

import simpy

from uwblink.twr import Protocol, Role
from uwbsim.clock import SUBTICKS_PER_SECOND

PATIENCE_S: Final = 6.73e-3
"""Longest wait from one frame's timestamp to the next one's.

The preamble timeout of 6.521 ms (firmware wire format, 3.1) starts when the receiver is on again,
some 70 us after the stamp, and the next preamble starts 138 us before its own stamp.
"""

TURNAROUND_S: Final = 0.5e-3
"""From the end of an exchange until the initiator's host can command the next."""

Waiting = Generator[simpy.Event, Any, None]


@dataclass(frozen=True, slots=True)
class Slot:
    """One planned exchange: when, who, and what the radios will make of each message.

    `heard[k]` says whether message k is above the receiver's sensitivity, `delay[k]` is the
    sub-ticks from the stamp it waits for until message k leaves, `flight` its sub-ticks in the air.
    """

    start: int
    initiator: int
    target: int
    heard: tuple[bool, ...]
    delay: tuple[int, ...]
    flight: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """What became of a slot: when its poll left, and the message that was lost, or -1."""

    start: int
    lost: int


class Air:
    """Carries each frame to its receiver after its flight time, unless it is too weak to hear.

    A board takes polls from its interrupt handler and everything else from the busy wait of the
    exchange it is in: hence two inboxes a tag.
    """

    def __init__(self, env: simpy.Environment, tags: int) -> None:
        """Open the inboxes of `tags` tags."""
        self.env = env
        self.polls = [simpy.Store(env) for _ in range(tags)]
        self.answers = [simpy.Store(env) for _ in range(tags)]

    def send(self, slot: Slot, number: int, receiver: int) -> None:
        """Put message `number` of a slot on the air, now."""
        if slot.heard[number]:
            inbox = (self.answers if number else self.polls)[receiver]
            arrival = self.env.timeout(slot.flight, slot)
            arrival.callbacks.append(lambda event: _deliver(inbox, event))


def _deliver(inbox: simpy.Store, arrival: simpy.Event) -> None:
    inbox.put(arrival.value)


def run(
    protocol: Protocol,
    slots: list[Slot],
    tags: int,
    progress: Callable[[float], None] | None = None,
) -> list[Outcome]:
    """Play the slots one after the other; returns what became of each, in order."""
    env = simpy.Environment()
    air = Air(env, tags)
    outcomes: list[Outcome] = []
    for tag in range(tags):
        env.process(_answer(env, air, protocol, tag))
    done = env.process(_plan(env, air, protocol, slots, outcomes, progress))
    env.run(until=done)
    return outcomes


def _plan(
    env: simpy.Environment,
    air: Air,
    protocol: Protocol,
    slots: list[Slot],
    outcomes: list[Outcome],
    progress: Callable[[float], None] | None,
) -> Waiting:
    turnaround = int(TURNAROUND_S * SUBTICKS_PER_SECOND)
    for count, slot in enumerate(slots):
        if slot.start > env.now:
            yield env.timeout(slot.start - int(env.now))
        start = int(env.now)
        yield env.process(_exchange(env, air, protocol, slot))
        outcomes.append(Outcome(start, slot.heard.index(False) if False in slot.heard else -1))
        yield env.timeout(turnaround)
        if progress and not count % 500:
            progress(count / len(slots))


def _exchange(env: simpy.Environment, air: Air, protocol: Protocol, slot: Slot) -> Waiting:
    """Initiate an exchange; ends when the initiator is done or has given up."""
    air.send(slot, 0, slot.target)
    yield from _play(env, air, protocol, slot, "initiator")


def _answer(env: simpy.Environment, air: Air, protocol: Protocol, tag: int) -> Waiting:
    """Wait for polls, for ever, and take the target's part in each exchange."""
    while True:
        slot = yield air.polls[tag].get()
        yield from _play(env, air, protocol, slot, "target")


def _play(env: simpy.Environment, air: Air, protocol: Protocol, slot: Slot, role: Role) -> Waiting:
    """Send and receive what follows the poll, as the protocol's rows say; stop at a missing frame."""
    me, other = slot.initiator, slot.target
    if role == "target":
        me, other = other, me
    for number, message in enumerate(protocol.messages[1:], start=1):
        if message.sender == role:
            yield env.timeout(slot.delay[number])
            air.send(slot, number, other)
            continue
        frame = air.answers[me].get()
        yield frame | env.timeout(int(PATIENCE_S * SUBTICKS_PER_SECOND))
        if not frame.triggered:
            frame.cancel()
            return
