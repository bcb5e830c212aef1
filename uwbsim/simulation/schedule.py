"""Who ranges with whom, and when: the plans of a scenario, as slots that hosts play.

A host is whoever commands boards one after the other. In a round robin one host commands all; otherwise every
initiator has its own, and nothing keeps two from talking at once but the plan.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from uwblink.arrays import Floats, Ints
from uwbsim.random_streams import stream
from uwbsim.scenario.model import Scenario
from uwbsim.world.true_time import SUBTICKS_PER_SECOND


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
    return PLANS[scenario.ranging.plan](scenario, pairs)


def _round_robin(scenario: Scenario, pairs: Ints) -> Schedule:
    """One host, pair after pair, at the rate."""
    start, turn = _turns(scenario, pairs)
    return _schedule(start, turn, np.zeros(len(turn), dtype=np.int64))


def _tdma(scenario: Scenario, pairs: Ints) -> Schedule:
    """The same turns, but every initiator has a host of its own, whose clock is off by `sync_error_ms`."""
    start, turn = _turns(scenario, pairs)
    error_s = stream(scenario.run.seed, "sync error").normal(size=len(scenario.tags))
    late = error_s * scenario.ranging.sync_error_s
    return _schedule(np.maximum(start + late[turn[:, 0]], 0), turn, turn[:, 0])


def _aloha(scenario: Scenario, pairs: Ints) -> Schedule:
    """Every initiator ranges at random times with one of its targets; the rates add up to the plan's."""
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


def _common_list(scenario: Scenario, pairs: Ints) -> Schedule:
    """Every robot knows the list and begins when it has heard the exchange before its own.

    Who is too far away to hear it waits for `list_timeout_ms` more. The order of the list is kept by the one before.
    """
    start, turn = _turns(scenario, pairs)
    return _schedule(start, turn, np.zeros(len(turn), dtype=np.int64))


PLANS: Final[dict[str, Callable[[Scenario, Ints], Schedule]]] = {
    "round-robin": _round_robin,
    "tdma": _tdma,
    "aloha": _aloha,
    "common-list": _common_list,
}


def _turns(scenario: Scenario, pairs: Ints) -> tuple[Floats, Ints]:
    count = int(scenario.run.duration_s * scenario.ranging.rate_hz)
    return np.arange(count) / scenario.ranging.rate_hz, pairs[np.arange(count) % len(pairs)]


def _schedule(start_s: Floats, pairs: Ints, host: Ints) -> Schedule:
    order = np.argsort(start_s, kind="stable")
    start = (start_s[order] * SUBTICKS_PER_SECOND).astype(np.int64)
    return Schedule(start, pairs[order, 0], pairs[order, 1], host[order])
