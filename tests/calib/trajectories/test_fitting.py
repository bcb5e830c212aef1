"""Delays planted in flights whose distances nobody knows: sums of sines, seen by their ranges alone after a while."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import calib
from tests.calib.trajectories.sines import DELAYS_NS, flight


def errors_ns(result):
    found = result.calibration
    return np.array([found.delays_ns[tag] - delay for tag, delay in DELAYS_NS.items()])


@pytest.fixture(scope="module")
def flown():
    return flight(wander_deg=3.0)


@pytest.fixture(scope="module")
def fitted(flown):
    shares: list[float] = []
    result = calib.fit_from_ranges(flown, poses_until_s=8.0, progress=shares.append)
    return result, shares


def test_planted_delays_are_found_from_a_known_start(flown, fitted):
    result, _ = fitted
    std = np.array(list(result.calibration.delays_std_ns.values()))
    assert result.success
    # Nothing is doubted of a sound flight, but that it is short.
    assert [warning[:12] for warning in result.warnings] == ["only 24 s of"]
    # One flight of 24 s: a fit with all distances known leaves 18 ps.
    assert np.abs(errors_ns(result) / std).max() < 3.5
    assert 0.015 < std.max() < 0.06
    rows = np.searchsorted(flown.exchanges.time_ns, result.ranges.time_ns)
    away = result.ranges.truth_m - flown.distance_m[rows]
    assert np.std(away) < 0.02
    assert abs(np.mean(away)) < 0.01


def test_what_a_fit_rests_on_is_said_and_progress_rises(fitted):
    result, shares = fitted
    known = result.calibration.provenance
    assert known["truth"] == "ranges"
    assert known["rests_on"]["known_s"] == pytest.approx(7.9, abs=0.11)
    assert known["rests_on"]["moving"] == ["robot0", "robot1", "robot2"]
    assert 0.005 < known["distance_std_m"] < 0.02
    assert shares == sorted(shares)
    assert shares[-1] == 1.0


def test_it_corrects_ranges_of_another_flight_as_any_calibration(fitted):
    other = flight(seed=9)
    truth = other.distance_m
    applied = fitted[0].calibration.apply(calib.load_ranges(other))
    # Reflected ranges aside, what is left of the bias is far below that of raw ones.
    assert abs(np.median(applied.corrected_m - truth)) < 0.012
    assert abs(np.median(applied.raw_m - truth)) > 0.012


def test_a_curve_is_taken_from_another_calibration_with_what_is_unsure_of_it(fitted):
    known = fitted[0].calibration
    flown = flight(seconds=10.0, seed=3)
    found = calib.fit_from_ranges(flown, poses_until_s=5.0, heading_std_deg=0.0, curve_from=known).calibration
    assert found.bias_curve == known.bias_curve
    assert (found.lift, found.alpha_dbm) == (known.lift, known.alpha_dbm)
    std = np.array([found.delays_std_ns[tag] for tag in DELAYS_NS])
    assert np.abs(np.array([found.delays_ns[tag] - delay for tag, delay in DELAYS_NS.items()]) / std).max() < 3.5
    exact = replace(known, uncertainty=None)
    surer = calib.fit_from_ranges(flown, poses_until_s=5.0, heading_std_deg=0.0, curve_from=exact).calibration
    assert all(surer.delays_std_ns[tag] < found.delays_std_ns[tag] for tag in DELAYS_NS)


def test_a_curve_that_cannot_be_taken_is_named(flown, fitted):
    known = fitted[0].calibration
    wrongs: tuple[dict[str, Any], ...] = ({"delays_only": True}, {"groups": {"all": (1, 2, 3, 4, 5, 6)}})
    for wrong in wrongs:
        with pytest.raises(calib.BadInputError, match="does not go with") as raised:
            calib.fit_from_ranges(flown, curve_from=known, **wrong)
        assert raised.value.parameter == "curve_from"
    with pytest.raises(calib.BadInputError, match="a curve of each reception"):
        calib.fit_from_ranges(flown, curve_from=replace(known, power_at="reception"))


def test_nearly_exact_ranges_give_nearly_exact_delays():
    result = calib.fit_from_ranges(flight(seconds=14.0, noise_m=0.0, reflected=0.0, wander_deg=0.0), poses_until_s=7.0)
    # Stamps are whole ticks, 2.3 mm of range; control points every 0.4 s follow these sines to millimetres.
    assert np.abs(errors_ns(result)).max() < 0.03


def test_a_bad_parameter_is_named(flown):
    wrong: dict[str, Any] = {"attitudes": "guess", "anchors": "moved", "poses_until_s": -1.0, "heading_std_deg": np.nan}
    for name, value in wrong.items():
        with pytest.raises(calib.BadInputError) as raised:
            calib.fit_from_ranges(flown, **{name: value})
        assert raised.value.parameter == name


ANCHORS = [[3.5, 3.5, 0.3], [-3.5, 3.5, 2.6], [-3.5, -3.5, 0.5], [3.5, -3.5, 2.5]]


def test_places_of_anchors_make_up_for_a_known_start():
    flown = flight(seconds=16.0, rate=120, anchors=ANCHORS)
    result = calib.fit_from_ranges(flown, poses_until_s=0.0)
    away = result.ranges.truth_m - flown.distance_m[np.searchsorted(flown.exchanges.time_ns, result.ranges.time_ns)]
    # Lever arms of anchors are 37 cm long, each turned another way.
    assert np.std(away) < 0.03
    std = np.sqrt(np.diag(result.calibration.uncertainty.delays_ns2))
    assert result.calibration.provenance["rests_on"]["known_s"] == 0
    assert np.abs(errors_ns(result) / std[:6]).max() < 3.5
    assert std[:6].max() < 0.1


def test_sought_anchors_do_not_spoil_what_a_known_start_tells():
    flown = flight(seconds=16.0, rate=120, anchors=ANCHORS, seed=2)
    result = calib.fit_from_ranges(flown, poses_until_s=8.0, anchors="sought")
    found = result.calibration
    std = np.sqrt(np.diag(found.uncertainty.delays_ns2))
    assert np.abs(errors_ns(result) / std[:6]).max() < 3.5
    # Where an anchor is and how late it answers are nearly the same from a flight in the middle of the room.
    assert all(np.isinf(found.delays_std_ns[tag]) for tag in (11, 12, 13, 14))
    assert "tags 11, 12, 13, 14" in result.warnings[0]
