"""The air: durations, collisions, capture, busy boards, and waits."""

from pathlib import Path

import numpy as np
import pytest

from uwblink.protocols.table import PROTOCOLS
from uwbsim.scenario.loading import load
from uwbsim.scenario.ranging import before_marker_s, exchange_air_s, frame_s
from uwbsim.simulation import air
from uwbsim.simulation.run import simulate
from uwbsim.world.clocks import SUBTICKS_PER_SECOND

US = SUBTICKS_PER_SECOND // 1_000_000
DS = PROTOCOLS["ds"]
TRAIN = Path(__file__).parents[3] / "scenarios" / "icra2023" / "train.toml"


@pytest.mark.parametrize(("length", "us"), [(11, 177.37), (8, 174.29), (28, 194.81), (100, 280.96)])
def test_frames_last_as_long_as_on_the_boards(length, us):
    assert frame_s(length, 128) * 1e6 == pytest.approx(us, abs=0.01)
    assert before_marker_s(128) * 1e6 == pytest.approx(138.397, abs=0.001)


def test_an_exchange_keeps_the_air_busy_for_its_three_frames():
    assert exchange_air_s(DS, 128) * 1e6 == pytest.approx(177.37 + 174.29 + 194.81, abs=0.02)


def slot(number, at_us, initiator, target, heard=(True, True, True), reply_us=305, final_us=1538, pause_us=0):
    return number, at_us * US, initiator, target, pause_us * US, heard, (0, reply_us * US, final_us * US)


def columns(hosts):
    """Return the slots of hosts as the event loop takes them, and the numbers of each host's."""
    rows = sorted(row for host in hosts for row in host)
    assert [row[0] for row in rows] == list(range(len(rows)))
    _, start, initiator, target, pause, heard, delay = zip(*rows, strict=True)
    slots = air.Slots([*start], [*initiator], [*target], [*pause], np.array(heard).T, np.array(delay).T)
    return slots, [[row[0] for row in host] for host in hosts]


def played(hosts, powers=None, capture_db=6.0):
    table = np.full((8, 8), -80.0) if powers is None else powers
    rules = air.Rules(sensitivity_dbm=-100.0, capture_db=capture_db, preamble_symbols=128)
    slots, numbers = columns(hosts)
    return air.run(DS, slots, numbers, 8, lambda sender, _time: table[sender], rules)


def test_alone_every_exchange_succeeds_and_starts_when_it_should():
    outcome = played([[slot(0, 0, 0, 1), slot(1, 5000, 1, 2)]])
    assert outcome.lost == [-1, -1]
    assert np.diff(outcome.start)[0] / US == pytest.approx(5000, abs=1)


def test_a_missing_message_costs_the_preamble_timeout():
    outcome = played([[slot(0, 0, 0, 1, (True, False, True)), slot(1, 100, 0, 1)]])
    assert (outcome.lost, outcome.reason) == ([1, -1], [air.WEAK, ""])
    # From marker to marker: the rest of the poll, the receiver going on, the wait, the next command, its preamble.
    assert np.diff(outcome.start)[0] / US == pytest.approx(39 + 40 + 6521 + 1000 + 138.4, abs=2)


def test_two_polls_at_once_collide_at_equal_power():
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 50, 2, 3)]])
    assert set(outcome.reason) == {air.COLLIDED}
    assert outcome.lost == [0, 0]


def test_the_stronger_and_earlier_frame_is_captured():
    powers = np.full((8, 8), -80.0)
    powers[2, :] = -95.0  # the second initiator is 15 dB weaker everywhere ...
    powers[2, 3] = -80.0  # ... except at its own target
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 50, 2, 3)]], powers)
    assert outcome.reason[0] == ""
    assert outcome.reason[1] == air.COLLIDED
    late = played([[slot(0, 50, 0, 1)], [slot(1, 0, 2, 3)]], powers)
    assert late.reason[0] == air.COLLIDED, "stronger, but later: the receiver is locked on the other"


def test_who_is_too_far_away_does_not_disturb():
    powers = np.full((8, 8), -80.0)
    powers[np.ix_([0, 1], [2, 3])] = powers[np.ix_([2, 3], [0, 1])] = -120.0
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 50, 2, 3)]], powers)
    assert outcome.lost == [-1, -1]


def test_a_target_in_another_exchange_does_not_hear_a_poll():
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 900, 2, 1)]])
    assert outcome.reason[1] == air.BUSY


def test_a_board_that_waits_takes_the_first_frame_that_comes():
    # The second poll falls between the first exchange's response and its final.
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 800, 2, 3)]])
    assert outcome.lost[0] == 2
    assert outcome.reason[0] == air.FOREIGN


def test_a_final_later_than_the_preamble_timeout_is_too_late():
    outcome = played([[slot(0, 0, 0, 1, final_us=6900)]])
    assert (outcome.lost[0], outcome.reason[0]) == (2, air.LATE)


def test_an_initiator_that_is_being_ranged_with_waits_until_it_is_free():
    powers = np.full((8, 8), -80.0)
    outcome = played([[slot(0, 0, 0, 1)], [slot(1, 600, 1, 2)]], powers)
    assert outcome.lost == [-1, -1]
    assert outcome.start[1] / US > 305 + 1538


@pytest.mark.parametrize(
    ("plan", "rate_hz", "sync_error_ms"), [("aloha", 40.0, 0.0), ("aloha", 150.0, 0.0), ("tdma", 120.0, 6.0)]
)
def test_what_is_one_event_ends_as_message_by_message(monkeypatch, plan, rate_hz, sync_error_ms):
    settings = {
        "run.duration_s": 20.0,
        "ranging.plan": plan,
        "ranging.rate_hz": rate_hz,
        "ranging.sync_error_ms": sync_error_ms,
        "radio.sensitivity_dbm": -92.0,
    }
    scenario = load(TRAIN, settings)
    quick, single = simulate(scenario), 0
    plain = air.Air._alone

    def counted(self, number, begin):
        nonlocal single
        single += plain(self, number, begin)
        return False

    monkeypatch.setattr(air.Air, "_alone", counted)
    slow = simulate(scenario)
    assert quick.faults == slow.faults
    assert single > 0.2 * len(slow.exchanges)
    assert len(slow.faults) > 0.02 * len(slow.exchanges), "there is something to disturb exchanges"
    np.testing.assert_array_equal(quick.exchanges.time_ns, slow.exchanges.time_ns)
    np.testing.assert_array_equal(quick.exchanges.rx3, slow.exchanges.rx3)
