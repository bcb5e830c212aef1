"""Broadcasts in slots: losses of frames that overlap, and what the recording has of the others.

A frame is planned and stamped as one message to each listener (`air.schedule`, `timestamps.stamp`), so the rows of a
frame follow each other. Slots depend on nothing that is received: there is no event loop.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uwblink.arrays import Ints
from uwblink.receptions import Receptions, exchanges_in
from uwblink.ticks import COUNTER_BITS
from uwbsim.scenario.ranging import broadcast_s
from uwbsim.simulation.air import BUSY, COLLIDED, Outcomes, Schedule
from uwbsim.simulation.timestamps import Draws, Stamped, printed_readings, time_ns
from uwbsim.world.clocks import NS_PER_S, SUBTICKS_PER_SECOND
from uwbsim.world.reception import Medium


def one_departure(draws: Draws, listeners: int) -> Draws:
    """Return draws with the same noise of departure in all rows of a frame."""
    return replace(draws, transmit=np.repeat(draws.transmit[:, ::listeners], listeners, axis=1))


def with_collisions(medium: Medium, plan: Schedule, alone: Outcomes) -> Outcomes:
    """Return outcomes with the losses by frames that overlap: a collision, or a listener that sends itself."""
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


def reported(medium: Medium, kept: Ints, planned: int, rows: Schedule, stamped: Stamped) -> dict[str, Any]:
    """Return what tags report of the `kept` rows (n,), of all `planned`: receptions, and the exchanges that they make.

    Stamps are the chip's whole ones. `truth_m` are the distances at the polls, which ranges measure (`range_ns`).
    """
    ids = np.array([tag.id for tag in medium.scenario.tags], dtype=np.int64)
    fpp, skew = printed_readings(medium, 1, kept, planned, stamped)
    tx, rx = (stamped.stamps[name] & ((1 << COUNTER_BITS) - 1) for name in ("tx1", "rx1"))
    receptions = Receptions(
        time_ns=time_ns(stamped.frames[0].departure),
        frame=kept // (len(ids) - 1),
        sender=ids[rows.initiator],
        listener=ids[rows.target],
        tx=tx,
        rx=rx,
        fpp_dbm=fpp,
        rxp_dbm=np.full(len(kept), np.nan),
        skew_ppm=skew,
    )
    exchanges, overheard = exchanges_in(receptions)
    i, j = (np.argmax(ends[:, None] == ids, axis=1) for ends in (exchanges.initiator, exchanges.target))
    poll = np.rint(exchanges.time_ns * (SUBTICKS_PER_SECOND / NS_PER_S)).astype(np.int64)
    truth_m = medium.links.link(i, j, poll).distance_m
    return {"exchanges": exchanges, "overheard": overheard, "receptions": receptions.to_dict(), "truth_m": truth_m}
