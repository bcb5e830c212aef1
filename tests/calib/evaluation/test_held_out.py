"""A fit judged on a part of its own ranges, which a second fit has not seen."""

import numpy as np
import pytest

import calib


def test_a_part_that_is_held_out_judges_a_fit_to_the_others():
    flight = calib.load_ranges(calib.sample_flight(3000))
    plain = calib.fit(flight).calibration
    found = calib.fit(flight, hold_out=0.3).calibration
    assert found.delays_ns == plain.delays_ns, "what is returned is fitted to all"
    told = found.provenance["held_out"]
    assert 0.25 * len(flight) < told["ranges"] < 0.35 * len(flight)
    assert abs(told["median_m"]) < 0.01 < abs(told["raw_median_m"])
    assert told["robust_std_m"] == pytest.approx(0.03, rel=0.1)
    assert told["inside_95"] > 0.9
    assert "held_out" not in plain.provenance


def test_what_is_held_out_was_not_fitted():
    """A constant of 20 cm in the last tenth of the time is seen whole by a fit that did not have it."""
    flight = calib.load_ranges(calib.sample_flight(3000))
    late = flight.time_ns > np.quantile(flight.time_ns, 0.9)
    moved = calib.Ranges.from_arrays(
        flight.raw_m + 0.2 * late, initiator=flight.initiator, target=flight.target, fpp1_dbm=flight.fpp1_dbm,
        fpp2_dbm=flight.fpp2_dbm, truth_m=flight.truth_m, time_ns=flight.time_ns,
    )  # fmt: skip
    told = calib.fit(moved, hold_out=0.1).calibration.provenance["held_out"]
    assert told["median_m"] == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize("changes", [{"hold_out": 1.0}, {"hold_out": float("nan")}, {"hold_out": 0.3, "fold": "week"}])
def test_settings_that_hold_nothing_out(changes):
    with pytest.raises(calib.BadInputError):
        calib.fit(calib.sample_flight(), **changes)


def test_one_session_cannot_be_held_out():
    with pytest.raises(calib.UnanswerableError, match="session"):
        calib.fit(calib.sample_flight(), hold_out=0.3, fold="session")
