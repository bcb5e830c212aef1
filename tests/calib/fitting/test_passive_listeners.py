"""Delays from overheard exchanges: each target separately, for any graph of pairs, without the split of a delay."""

from pathlib import Path

import pytest

import uwblink
from calib import fit, load_ranges
from calib.fitting.passive_listeners import heard_delays
from tests.calib.synthetic import calibration
from uwbsim import load, simulate

SCENARIOS = Path(__file__).parents[3] / "scenarios"
PASSIVE = [f"tags.{k}.passive=true" for k in range(6)]


def recorded(tmp_path, scenario, *settings):
    path = tmp_path / "f.uwb"
    simulate(load(SCENARIOS / scenario, settings)).save(path, force=True)
    return path


NOTHING = calibration(dict.fromkeys(range(1, 7), 0.0), 0.1)


def test_without_noise_listeners_give_the_planted_delays(tmp_path):
    path = recorded(tmp_path, "noiseless.toml", "run.duration_s=20", *PASSIVE)
    planted = load_ranges(path).planted["delays_ns"]
    heard = heard_delays(load_ranges(path), NOTHING)
    assert len(heard) >= 3
    for tag, found in heard.items():
        # Stamps are whole ticks of 15.6 ps, five of them; hundreds of exchanges average them to less than a picosecond,
        # but the ratio of clocks over a third interval five times as long adds a drift of some picoseconds.
        assert found.delay_ns == pytest.approx(planted[str(tag)], abs=0.005), tag


@pytest.mark.slow
def test_listeners_agree_with_the_fit_of_a_noisy_flight(tmp_path):
    path = recorded(tmp_path, "icra2023/train.toml", "run.duration_s=60", *PASSIVE)
    ranges = load_ranges(path)
    found = fit(ranges).calibration
    heard = heard_delays(ranges, found)
    assert (heard_delays(load_ranges(uwblink.load(path)), found), len(heard)) == (heard, 4)
    # Both have the constant of the curve in the same gauge. A fit of 60 s determines a delay to 17 ps, listeners to 8
    # ps.
    for tag, one in heard.items():
        assert one.delay_ns == pytest.approx(found.delays_ns[tag], abs=0.06)


def test_without_listeners_there_are_no_delays(tmp_path):
    assert heard_delays(load_ranges(recorded(tmp_path, "icra2023/train.toml", "run.duration_s=5")), NOTHING) == {}
