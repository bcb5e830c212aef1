"""Exchanges, poses and receptions from arrays, and as columns; their text form; exchanges in receptions."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import uwbsim
from tests.uwblink.recording.test_file import random_exchanges
from uwblink import errors, raw_range
from uwblink.errors import ArgumentError, UwblinkError
from uwblink.importers import read_source
from uwblink.receptions import Receptions, contradicted, exchanges_in, times_by_stamps
from uwblink.recording.schema import Poses
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S
from uwblink.twr import COLUMNS, Exchanges

SS: dict[str, Any] = {"tx1": [0, 9], "rx1": [5, 3], "tx2": [1005, 1003], "rx2": [3000, 3009]}
DS: dict[str, Any] = SS | {"tx3": [99_005, 99_003], "rx3": [101_000, 101_009]}


def test_ranges_without_stamps_are_those_of_a_table_without_stamps(tmp_path):
    """A registered importer for a device that prints ranges needs no stamps."""
    (tmp_path / "t.csv").write_text("time_s,from_id,to_id,range_m,fpp2\n0.5,1,7,3.1,-82.5\n0.6,2,7,3.2,-83.0\n")
    table = read_source(tmp_path / "t.csv").exchanges
    mine = Exchanges.from_arrays(
        [1, 2], 7, range_m=[3.1, 3.2], fpp2_dbm=[-82.5, -83.0], time_ns=table.time_ns, reporter=table.reporter
    )
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(mine, name), getattr(table, name), err_msg=name)


def test_one_value_applies_to_all_rows_and_each_row_keeps_to_its_protocol():
    """Whole floats are accepted; stamps that a protocol has not are zero."""
    floats: Any = {k: np.array(v, dtype=float) for k, v in DS.items()}
    x = Exchanges.from_arrays(1, 2, **floats, protocol="ds-alt")
    assert (x.target.tolist(), x.protocol.tolist(), str(x.tx3.dtype)) == ([2, 2], ["ds-alt"] * 2, "int64")
    assert Exchanges.from_arrays(1, 2, **DS, protocol=["ss", "ds"]).tx3.tolist() == [0, 99_003]
    assert Exchanges.from_arrays(1, 2, **DS).protocol.tolist() == ["ds", "ds"]


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        ({"target": 2, "tx1": [3], "range_m": [3.1]}, "rx1: is missing"),
        ({"target": 2, "rx1": [3], "range_m": [3.1]}, "tx1: is missing"),
        ({}, "tx1: is missing; give the stamps, or range_m"),
        *((SS | change, expected) for change, expected in (
        ({"rx2": [1, 2, 3]}, "rx2: found 3 rows, expected 2 as in the first column"),
        ({"tx1": [[1, 2]]}, r"tx1: found an array of shape \(1, 2\), expected one value a row"),
        ({"tx1": 5}, r"tx1: found an array of shape \(\), expected one value a row"),
        ({"rx1": [[1], [2, 3]]}, "rx1: expected one value a row"),
        ({"rx1": [5, 2**32]}, "rx1: row 1: found 4294967296, expected a whole number from 0 to 4294967295; stamps of"),
        ({"rx1": [5, -1]}, "rx1: row 1: found -1, expected a whole number from 0"),
        ({"rx1": [5.5, 1]}, "rx1: row 0: found 5.5, expected a whole number"),
        ({"rx1": [5, np.nan]}, "rx1: row 1: found nan, expected a whole number"),
        ({"rx1": ["5", "6"]}, "rx1: found '5' .*, expected whole numbers"),
        ({"rx1": [True, False]}, "rx1: found 'True' .*, expected whole numbers"),
        ({"protocol": "tdoa"}, "protocol: found 'tdoa', allowed: ss, ss-cfo, ds"),
        ({"protocol": ["ss", 3]}, "protocol: found .*, expected text|protocol: found '3', allowed"),
        ({"protocol": ["ss", "ds"]}, "tx3: is missing, but protocol 'ds' needs it"),
        ({"tx3": [1, 2]}, "rx3: is missing; a third message has both stamps"),
        ({"target": [3, 1]}, "target: row 1: found 1, expected another tag than the initiator"),
        ({"target": 70_000}, "target: row 0: found 70000, expected a whole number from 0 to 65535"),
        ({"bits": 33}, "bits: found 33, allowed: 32, 40"),
        ({"fpp1_dbm": [-80, np.inf]}, "fpp1_dbm: row 1: found inf, expected a finite number, or NaN"),
        ({"fpp1_dbm": ["a", "b"]}, "fpp1_dbm: found 'a' .*, expected numbers"),
        ({"time_ns": 2**63}, "time_ns: row 0: found 9223372036854775808, expected a whole number from"),
        )),
    ],
)  # fmt: skip
def test_mistakes_name_column_row_and_what_is_expected(columns, expected):
    assert issubclass(ArgumentError, ValueError)
    assert issubclass(ArgumentError, UwblinkError)
    with pytest.raises(ArgumentError, match=rf"\A.*({expected}).*\Z"):
        Exchanges.from_arrays(**({"initiator": 1, "target": [2, 3]} | columns))


def test_exchanges_are_made_by_name_only():
    with pytest.raises(TypeError):
        Exchanges(*([np.zeros(1)] * 17))  # type: ignore[call-arg]


def test_rows_are_chosen_by_number_slice_and_mask():
    x = random_exchanges()
    assert len(x[3]) == 1
    assert x[3].tx1[0] == x[-47].tx1[0] == x[3:5].tx1[0] == x.tx1[3]
    assert len(x[x.protocol == "ss"]) == np.count_nonzero(x.protocol == "ss")


@pytest.mark.parametrize("count", [0, 1, 6, 7, 10_000])
def test_printed_tables_fit_on_a_screen(count):
    stamps: Any = {name: np.arange(count) + 2**31 for name in SS}
    x = Exchanges.from_arrays(1, 2, **stamps, time_ns=2**60)
    poses = Poses.from_arrays(np.arange(count) + 2**60, "\x1b[31m" + "long" * 30, (1 / 3, -2 / 3, 1e-9))
    for thing in (x, poses):
        lines = repr(thing).splitlines()
        assert (len(lines) <= 12, max(map(len, lines)) <= 79, str(count) in lines[0]) == (True, True, True), lines
        assert "\x1b" not in repr(thing) + thing._repr_html_()
    assert ("..." in repr(x)) == (count > 6)
    assert len(x._repr_html_()) < 6000


def test_poses_are_put_in_order_and_turned_to_length_one():
    poses = Poses.from_arrays([2, 1], ["b", "a"], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0, 1.05], [0, 0, -0.95, 0]])
    assert (poses.body.tolist(), poses.position_m.tolist()) == (["a", "b"], [[4, 5, 6], [1, 2, 3]])
    assert poses.quaternion.tolist() == [[0, 0, -1, 0], [0, 0, 0, 1]]
    columns = poses.to_dict()
    assert (columns["x"].tolist(), columns["qz"].tolist()) == ([4, 1], [-1, 0])
    assert {np.shape(column) for column in columns.values()} == {(2,)}


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"position_m": [1, 2]}, r"position_m: found an array of shape \(2,\), expected \(2, 3\) or \(3,\)"),
        ({"position_m": [[1, 2, 3], [1, np.nan, 3]]}, "position_m: row 1: found .*, expected finite numbers"),
        ({"position_m": "here"}, r"position_m: expected numbers of shape \(2, 3\)"),
        ({"quaternion": [1, 1, 0, 0]}, "quaternion: row 0: found .*, expected x y z w of length 1"),
        ({"body": [1, 2]}, "body: found '1' .*, expected text"),
        ({"time_ns": [0.5, 1]}, "time_ns: row 0: found 0.5, expected a whole number"),
    ],
)
def test_wrong_poses_name_column_and_row(change, expected):
    with pytest.raises(ArgumentError, match=expected):
        Poses.from_arrays(**({"time_ns": [1, 2], "body": "a", "position_m": [1.0, 2.0, 3.0]} | change))


# Receptions of frames: consistency of broadcasts and exchanges, by clocks that share no code with them.


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
