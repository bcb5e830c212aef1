"""Receptions of frames: consistency of broadcasts and exchanges, by clocks that share no code with them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import uwbsim
from uwblink import errors, raw_range
from uwblink.receptions import Receptions, contradicted, exchanges_in, times_by_stamps
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S

PLACES = np.array([[0.0, 0, 0], [5, 0, 0], [0, 7, 0], [4, 6, 1]])
RATE = 1 + np.array([3.0, -8.0, 12.0, -1.0]) * 1e-6
START = np.array([0.7, 3.1, 16.9, 9.0]) / TICK_S


def broadcasts(rounds=20, lost=(), slot_s=0.005):
    """Return receptions of four tags that send in turn, with clocks of different rates."""

    def stamp(tag, t):
        return int(np.rint(START[tag] + RATE[tag] * t / TICK_S)) % (1 << 40)

    rows = []
    for frame in range(4 * rounds):
        sender, t = frame % 4, 1 + frame * slot_s
        for k in range(4):
            if k != sender and (frame, k) not in lost:
                arrival = t + np.linalg.norm(PLACES[k] - PLACES[sender]) / SPEED_OF_LIGHT
                rows.append((round(t * 1e9), frame, sender + 10, k + 10, stamp(sender, t), stamp(k, arrival)))
    columns = dict(zip(("time_ns", "frame", "sender", "listener", "tx", "rx"), zip(*rows, strict=True), strict=True))
    return Receptions.from_arrays(**{name: list(column) for name, column in columns.items()}, bits=40)


def test_a_counter_that_restarts_makes_no_range():
    r = broadcasts()
    later = r.frame >= 38
    tx, rx = (np.where(later & (ends == 11), (stamp + 123_456_789_012) % 2**40, stamp) for ends, stamp in
              ((r.sender, r.tx), (r.listener, r.rx)))  # fmt: skip
    restarted = Receptions.from_arrays(r.frame, r.sender, r.listener, tx=tx, rx=rx, time_ns=r.time_ns)
    exchanges, _ = exchanges_in(restarted)
    assert np.abs(errors_m(exchanges)).max() < 0.01
    # One or two exchanges of each of the three pairs of that tag span the restart.
    count = len(exchanges_in(r)[0])
    assert count - 6 <= len(exchanges) <= count - 3


HUNDRED_NS = 6400
"""Ticks: 30 m, by which receivers of logged boards are wrong at times."""


def with_errors(r, ticks, listener=12):
    """Return receptions in which stamps of a listener are wrong by ticks, by frame."""
    rx = r.rx.copy()
    for frame, off in ticks.items():
        rows = (r.frame == frame) & (r.listener == listener)
        assert rows.any(), frame
        rx[rows] += off
    return replace(r, rx=rx % 2**r.bits)


def errors_m(exchanges):
    ends = np.column_stack([exchanges.initiator, exchanges.target]) - 10
    return raw_range(exchanges) - np.linalg.norm(PLACES[ends[:, 0]] - PLACES[ends[:, 1]], axis=1)


@pytest.mark.parametrize(
    ("lost", "ticks", "cost"),
    [
        pytest.param((), {40: HUNDRED_NS}, 2, id="amid others"),
        pytest.param((), {0: HUNDRED_NS}, 1, id="first of a link"),
        pytest.param((), {1: -HUNDRED_NS, 76: HUNDRED_NS}, 4, id="both ends"),
        pytest.param((), {77: HUNDRED_NS, 79: -HUNDRED_NS}, 4, id="last of two links"),
        pytest.param((), {40: HUNDRED_NS, 44: HUNDRED_NS}, 6, id="two that agree"),
        pytest.param((), {40: HUNDRED_NS, 44: -HUNDRED_NS}, 6, id="two that do not"),
        pytest.param((44, 48, 52, 56), {40: HUNDRED_NS}, 3, id="before a gap"),
        pytest.param((24, 28, 32, 36), {40: HUNDRED_NS}, 3, id="after a gap"),
        pytest.param((28, 32, 36, 44, 48, 52), {40: HUNDRED_NS}, 3, id="alone in a gap"),
    ],
)
def test_stamps_that_others_contradict_make_no_range(lost, ticks, cost):
    """Frames 0, 4, 8 ... are sent by tag 10: of 20, six are near each wrong one, and decide."""
    r = broadcasts(lost={(frame, 2) for frame in lost}, slot_s=0.02)
    whole, _ = exchanges_in(r)
    wrong = with_errors(r, ticks)
    found, overheard = exchanges_in(wrong)
    assert contradicted(r).sum() == 0
    assert np.abs(errors_m(found)).max() < 0.01
    assert len(whole) - cost <= len(found) < len(whole)
    there = wrong.rx[(wrong.listener == 12) & np.isin(wrong.frame, list(ticks))]
    assert not np.isin(np.concatenate([overheard["rx1"], overheard["rx2"], overheard["rx3"]]), there).any()


def test_unreliable_links_give_no_ranges():
    """As one of seven recorded boards received another: half of its receptions are wrong by 80 to 350 ns."""
    draw = np.random.default_rng(7)
    r = broadcasts(rounds=30, slot_s=0.08)
    frames = draw.choice(np.arange(0, 120, 4), 15, replace=False).tolist()
    off = draw.choice([-1, 1], 15) * draw.uniform(80, 350, 15) * 64
    found, _ = exchanges_in(with_errors(r, dict(zip(frames, off.astype(int).tolist(), strict=True))))
    assert np.abs(errors_m(found)).max() < 0.01
    of_link = np.isin(found.initiator, [10, 12]) & np.isin(found.target, [10, 12])
    assert (of_link.sum() < 15, (~of_link).sum() > 5 * 27) == (True, True)


def test_a_clock_that_jumps_costs_the_ranges_beside_the_jump_alone():
    r = broadcasts(rounds=30)
    late = HUNDRED_NS * (r.frame >= 60)
    jumped = replace(r, tx=r.tx + late * (r.sender == 11), rx=r.rx + late * (r.listener == 11))
    found, _ = exchanges_in(jumped)
    assert len(found) > len(exchanges_in(r)[0]) - 3 * 2 * 4


@pytest.mark.parametrize(("rate_hz", "loss"), [(200, 0.3), (20, 0.3), (5, 0.0)])
def test_no_stamp_of_flying_tags_is_left_out(rate_hz, loss):
    """Two quadcopters turn at 0.8 m/s with 100 ps of noise, clocks drift, and frames are lost."""
    changes = {"ranging.rate_hz": rate_hz, "run.duration_s": 1200 / rate_hz}
    columns: Any = uwbsim.simulate(uwbsim.load("broadcast", changes)).receptions
    r = Receptions(**columns)
    r = r[np.random.default_rng(1).random(len(r)) >= loss]
    assert contradicted(r).mean() < 0.001


def test_times_are_those_of_the_clocks_that_stamped_last():
    r = broadcasts(rounds=900, lost={(5, 2), (8, 1), (10, 1)}, slot_s=0.02)  # 72 s: counters wrap four times
    assert times_by_stamps(r) == pytest.approx(r.time_ns - r.time_ns[0], abs=72e9 * 12e-6)
    silent = (
        ((r.sender == 13) | (r.listener == 13)) & (r.frame >= 400) & (r.frame < 1000)
    )  # 12 s: more than half a wrap
    assert times_by_stamps(r[~silent])[-1] == pytest.approx(r.time_ns[-1] - r.time_ns[0], abs=72e9 * 12e-6)


def test_wrong_receptions_are_refused():
    with pytest.raises(errors.ArgumentError, match="listener: row 1"):
        Receptions.from_arrays([0, 1], [1, 2], [2, 2], tx=0, rx=1)
    with pytest.raises(errors.ArgumentError, match="2 receptions contain no exchange"):
        exchanges_in(Receptions.from_arrays([0, 1], [1, 2], [2, 1], tx=[0, 9], rx=[5, 20]))
