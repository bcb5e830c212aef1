"""Receptions of frames: what broadcasts and exchanges say of each other, by clocks that share no code with them."""

import numpy as np
import pytest

from uwblink import Exchanges, raw_range
from uwblink.errors import ArgumentError
from uwblink.receptions import Receptions, exchange_of, exchanges_in, receptions_of
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S

PLACES = np.array([[0.0, 0, 0], [5, 0, 0], [0, 7, 0], [4, 6, 1]])
RATE = 1 + np.array([3.0, -8.0, 12.0, -1.0]) * 1e-6
START = np.array([0.7, 3.1, 16.9, 9.0]) / TICK_S


def broadcasts(rounds=20, lost=(), slot_s=0.005, bits=40):
    """Return receptions of four tags that send in turn, by clocks that run at their own rates."""

    def stamp(tag, t):
        return int(np.rint(START[tag] + RATE[tag] * t / TICK_S)) & ((1 << bits) - 1)

    rows = []
    for frame in range(4 * rounds):
        sender, t = frame % 4, 1 + frame * slot_s
        for k in range(4):
            if k != sender and (frame, k) not in lost:
                arrival = t + np.linalg.norm(PLACES[k] - PLACES[sender]) / SPEED_OF_LIGHT
                rows.append((round(t * 1e9), frame, sender + 10, k + 10, stamp(sender, t), stamp(k, arrival)))
    columns = dict(zip(("time_ns", "frame", "sender", "listener", "tx", "rx"), zip(*rows, strict=True), strict=True))
    return Receptions.from_arrays(**{name: list(column) for name, column in columns.items()}, bits=bits)


@pytest.mark.parametrize("bits", [40, 32])
def test_broadcasts_in_turn_range_every_pair_and_overhear_it(bits):
    exchanges, overheard = exchanges_in(broadcasts(bits=bits))
    ends = np.column_stack([exchanges.initiator, exchanges.target])
    assert {tuple(sorted(pair)) for pair in ends.tolist()} == {(a, b) for a in range(10, 14) for b in range(a + 1, 14)}
    distance = np.linalg.norm(PLACES[ends[:, 0] - 10] - PLACES[ends[:, 1] - 10], axis=1)
    # Four rounded stamps of 4.7 mm, two of them halved.
    assert np.abs(raw_range(exchanges) - distance).max() < 0.01
    # An exchange needs the round after it, and one more where its target comes first; two others hear each.
    assert 6 * 18 <= len(exchanges) <= 6 * 19
    assert len(overheard["time_ns"]) == 2 * len(exchanges)
    assert (exchange_of(exchanges, overheard) >= 0).all()
    assert not (overheard["listener"] == overheard["initiator"]).any()
    assert not (overheard["listener"] == overheard["target"]).any()


def test_lost_frames_cost_their_exchanges_and_no_others_become_wrong():
    everything, _ = exchanges_in(broadcasts())
    exchanges, overheard = exchanges_in(broadcasts(lost={(5, 2), (8, 1), (10, 1)}))
    ends = np.column_stack([exchanges.initiator, exchanges.target]) - 10
    distance = np.linalg.norm(PLACES[ends[:, 0]] - PLACES[ends[:, 1]], axis=1)
    assert np.abs(raw_range(exchanges) - distance).max() < 0.01
    assert len(everything) - 6 <= len(exchanges) < len(everything)
    assert len(overheard["time_ns"]) < 2 * len(exchanges)
    polls = np.column_stack([ends, exchanges.tx1])
    assert len(np.unique(polls, axis=0)) == len(exchanges), "a poll counts once, though the next one was lost"


def test_a_counter_that_restarts_makes_no_range():
    r = broadcasts()
    later = r.frame >= 38
    tx, rx = (np.where(later & (ends == 11), (stamp + 123_456_789_012) % 2**40, stamp) for ends, stamp in
              ((r.sender, r.tx), (r.listener, r.rx)))  # fmt: skip
    restarted = Receptions.from_arrays(r.frame, r.sender, r.listener, tx=tx, rx=rx, time_ns=r.time_ns)
    exchanges, _ = exchanges_in(restarted)
    ends = np.column_stack([exchanges.initiator, exchanges.target]) - 10
    distance = np.linalg.norm(PLACES[ends[:, 0]] - PLACES[ends[:, 1]], axis=1)
    assert np.abs(raw_range(exchanges) - distance).max() < 0.01
    # Of the three pairs of that tag one exchange each spans the restart, or two.
    count = len(exchanges_in(r)[0])
    assert count - 6 <= len(exchanges) <= count - 3


def test_a_stamp_that_its_neighbours_contradict_makes_no_range():
    r = broadcasts()
    whole, _ = exchanges_in(r)
    # A hundred nanoseconds, 30 m, as receivers of logged boards have it at times.
    wrong = (r.frame == 40) & (r.listener == 12)
    rx = np.where(wrong, r.rx + 6400, r.rx)
    found, overheard = exchanges_in(
        Receptions.from_arrays(r.frame, r.sender, r.listener, tx=r.tx, rx=rx, time_ns=r.time_ns)
    )
    ends = np.column_stack([found.initiator, found.target]) - 10
    distance = np.linalg.norm(PLACES[ends[:, 0]] - PLACES[ends[:, 1]], axis=1)
    assert np.abs(raw_range(found) - distance).max() < 0.01
    assert len(whole) - 2 <= len(found) < len(whole)
    assert not np.isin(overheard["rx1"], rx[wrong]).any()


def test_exchanges_give_their_receptions_and_those_of_listeners():
    exchanges, overheard = exchanges_in(broadcasts(rounds=4))
    own = receptions_of(exchanges, overheard)
    # Three messages at their receivers, and at two listeners each.
    assert len(own) == 9 * len(exchanges)
    again = own[np.isin(own.frame, own.frame[own.frame // 3 == 0])]
    assert len(np.unique(again.frame)) == 3
    first, heard = exchanges_in(again)
    assert {name: getattr(first, name).tolist() for name in ("tx1", "rx2", "rx3")} == {
        name: getattr(exchanges[:1], name).tolist() for name in ("tx1", "rx2", "rx3")
    }
    assert len(heard["time_ns"]) == 2


def test_two_messages_are_two_receptions():
    x = Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000], fpp1_dbm=[-80.0])
    found = receptions_of(x)
    assert found.sender.tolist() == [1, 2]
    assert found.listener.tolist() == [2, 1]
    assert found.fpp_dbm[0] == -80.0


def test_receptions_that_cannot_be_are_refused_by_name():
    with pytest.raises(ArgumentError, match="listener: row 1"):
        Receptions.from_arrays([0, 1], [1, 2], [2, 2], tx=0, rx=1)
    with pytest.raises(ArgumentError, match="2 receptions make no exchange"):
        exchanges_in(Receptions.from_arrays([0, 1], [1, 2], [2, 1], tx=[0, 9], rx=[5, 20]))
