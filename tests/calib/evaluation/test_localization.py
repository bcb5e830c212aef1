"""The EKF: consistent on clean ranges, better for a calibration, never locked out."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calib.calibration.model import Calibration
from calib.calibration.power_curves import Curve
from calib.errors import UnanswerableError
from calib.estimation.fitting import fit
from calib.evaluation.localization import Settings, as_tum, localize, summarize
from calib.sources import Flight, load_flight
from uwbsim.scenario.loading import load
from uwbsim.simulation.run import simulate, write

SCENARIOS = Path(__file__).parents[3] / "scenarios" / "icra2023"


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("flights")
    for name in ("train", "test1", "test2"):
        write(simulate(load(SCENARIOS / f"{name}.toml")), folder / f"{name}.uwb")
    return {name: load_flight(folder / f"{name}.uwb") for name in ("train", "test1", "test2")}


def flat(value):
    return Curve((0.0,) * 4 + (9.0,) * 4, (value,) * 4, 3, (0.0, 9.0))


def clean(flight: Flight, sigma_m=0.08) -> tuple[Flight, Calibration]:
    """True distances with Gaussian noise and nothing else, and a calibration that says so."""
    rng = np.random.default_rng(4)
    ranges = flight.ranges
    raw = ranges.truth_m + rng.normal(size=len(ranges)) * sigma_m
    tags = ranges.tags()
    calibration = Calibration(
        delays_ns=dict.fromkeys(tags, 0.0), delays_std_ns=dict.fromkeys(tags, 0.0), loss="cauchy", scale_ns=0.1,
        lift="mean-of-lifted", alpha_dbm=-82.0, speed_of_light=299702547.0, bias_curve=flat(0.0),
        sigma_curve=flat(sigma_m),
    )  # fmt: skip
    return replace(flight, ranges=replace(ranges, raw_m=raw)), calibration


def test_the_filter_is_consistent_on_clean_ranges(flights):
    # Without a gate, which cuts the largest hundredth of NIS away.
    found = summarize(localize(*clean(flights["test1"]), Settings(gate=1e9)))
    assert found.nis_bounds[0] < found.nis < found.nis_bounds[1]
    assert found.nees_bounds[0] < found.nees < found.nees_bounds[1]
    assert found.nis_bounds[1] - found.nis_bounds[0] < 0.05
    assert found.nees_bounds[1] - found.nees_bounds[0] < 1.5
    # Single values: 95 % lie within their own bounds, to the share that correlation leaves.
    assert found.nis_inside == pytest.approx(0.95, abs=0.01)
    assert found.nees_inside == pytest.approx(0.95, abs=0.03)


def test_a_filter_that_trusts_its_ranges_too_much_is_found_out(flights):
    flight, calibration = clean(flights["test1"])
    sure = replace(calibration, sigma_curve=flat(0.05))
    found = summarize(localize(flight, sure, Settings(gate=1e9)))
    assert found.nis > found.nis_bounds[1]
    assert found.nees > found.nees_bounds[1]


def test_a_calibration_is_worth_at_least_what_the_paper_found(flights):
    calibration = fit(flights["train"].ranges).calibration
    found = [one for name in ("test1", "test2") for one in localize(flights[name], calibration)]
    assert len(found) == 6
    summary = summarize(found)
    assert summary.reduction["variance"] >= 0.46
    assert summary.rmse_m["raw"] > summary.rmse_m["calibrated"] > summary.rmse_m["variance"]


def test_a_wrong_start_does_not_lock_the_filter_out(flights):
    flight, calibration = clean(flights["test1"])
    # A metre wrong, and sure of a decimetre: the gate refuses nearly everything until it reopens.
    jump = replace(flight, ranges=replace(flight.ranges, raw_m=flight.ranges.raw_m.copy()))
    early = jump.ranges.time_ns < jump.ranges.time_ns.min() + 2_000_000_000
    jump.ranges.raw_m[early] += 3.0
    for one in localize(jump, calibration, Settings(seed=3)):
        track = one.tracks["variance"]
        late = track.time_ns > track.time_ns.min() + 20_000_000_000
        wrong = np.linalg.norm(track.estimate_m[late] - track.truth_m[late], axis=1)
        assert np.median(wrong) < 0.15


def test_nothing_that_moves_is_nothing_to_localize(flights):
    flight, calibration = clean(flights["test1"])
    still = replace(flight, poses=replace(flight.poses, position_m=flight.poses.position_m * 0))
    with pytest.raises(UnanswerableError, match="no body moves"):
        localize(still, calibration)


def test_trajectories_are_written_in_tum_form(flights):
    flight, calibration = clean(flights["test1"])
    track = localize(flight, calibration)[0].tracks["raw"]
    lines = as_tum(track).splitlines()
    assert len(lines) == len(track.time_ns) + 1
    np.testing.assert_allclose([float(v) for v in lines[1].split()][1:4], track.estimate_m[0], atol=1e-6)
