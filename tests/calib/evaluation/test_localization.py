"""The EKF: consistent on clean ranges, more accurate with a calibration, and able to recover."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.stats import exponnorm, norm

from calib import BadInputError, Calibration, UnanswerableError, fit, sample_flight
from calib.data.sources import Flight, load_flight
from calib.evaluation.localization import fixed_std, localize, summarize, write_tum
from calib.evaluation.tracking import Settings, problems
from calib.online import RangeErrors, Reflections, mixture_update
from calib.report.figures import rmse_bars
from tests.calib.synthetic import calibration, constant_curve, track_errors
from tests.shared_data import ROOT
from uwblink.pages.figures import style
from uwbsim import load, simulate

SCENARIOS = ROOT / "scenarios" / "icra2023"


@pytest.fixture(scope="module")
def flights():
    return {name: load_flight(simulate(load(SCENARIOS / f"{name}.toml"))) for name in ("train", "test1")}


@pytest.fixture(scope="module")
def short():
    """The first four seconds of the test flight."""
    return load_flight(simulate(load(SCENARIOS / "test1.toml", {"run.duration_s": 4.0})))


@pytest.fixture(scope="module")
def fitted(flights):
    return fit(flights["train"].ranges).calibration


def beginning(flight, seconds):
    early = flight.ranges.time_ns < flight.ranges.time_ns.min() + seconds * 10**9
    return replace(flight, ranges=flight.ranges[early])


def clean(flight: Flight, sigma_m=0.08) -> tuple[Flight, Calibration]:
    """Return true distances with Gaussian noise only, and a calibration that states it."""
    ranges = flight.ranges
    raw = ranges.truth_m + np.random.default_rng(4).normal(size=len(ranges)) * sigma_m
    known = calibration(dict.fromkeys(ranges.tags(), 0.0), sigma_m)
    return replace(flight, ranges=replace(ranges, raw_m=raw)), known


@pytest.mark.slow
def test_the_filter_is_consistent_on_clean_ranges(flights):
    # Without a gate, which rejects the largest hundredth of NIS.
    found = summarize(localize(*clean(flights["test1"]), Settings(gate=1e9, seeds=1)))
    for mean, (low, high), width in ((found.nis, found.nis_bounds, 0.05), (found.nees, found.nees_bounds, 1.5)):
        assert low < mean < high < low + width
    # Single values: 95 % are within their own bounds, up to the effect of correlation.
    assert found.nis_inside == pytest.approx(0.95, abs=0.01)
    assert found.nees_inside == pytest.approx(0.95, abs=0.03)


def test_a_body_that_ranges_only_where_its_place_is_unknown_is_left_out(short):
    flight, known = clean(beginning(short, 2))
    first, *others = sorted({tag.body for tag in flight.tags})
    # The poses of one body are later than all ranges.
    time = flight.poses.time_ns + short.ranges.time_ns.max() * (flight.poses.body == first)
    poses = replace(flight.poses, time_ns=time)[np.argsort(time, kind="stable")]
    assert {one.body for one in localize(replace(flight, poses=poses), known, Settings(seeds=1))} == set(others)


@pytest.mark.slow
def test_overconfident_filters_are_detected(flights):
    flight, known = clean(beginning(flights["test1"], 20))
    found = summarize(localize(flight, replace(known, sigma_curve=constant_curve(0.05)), Settings(gate=1e9, seeds=1)))
    assert found.nis > found.nis_bounds[1]
    assert found.nees > found.nees_bounds[1]


def test_localization_without_data_is_refused(short):
    flight, known = clean(beginning(short, 1))
    with pytest.raises(UnanswerableError, match="ifo001"):
        summarize(localize(flight, known, Settings(gate=1e-12, seeds=1)))
    still = replace(flight, poses=replace(flight.poses, position_m=0 * flight.poses.position_m))
    with pytest.raises(UnanswerableError, match="memory"):
        localize(still, known)


@pytest.mark.slow
def test_a_calibration_reduces_the_error_by_a_third(flights, fitted):
    flight = beginning(flights["test1"], 20)
    found = localize(flight, fitted, Settings(seeds=2))
    summary = summarize(found)
    assert (len(found), summary.reduction["variance"] >= 0.4) == (3, True)
    # The error model of reflections reduces the error little here, but makes the filter consistent.
    raw, calibrated, variance, robust = (summary.rmse_m[name] for name in ("raw", "calibrated", "variance", "robust"))
    assert raw > calibrated > variance > robust / 1.02
    for name in ("variance", "robust"):
        assert 2.4 < np.mean(np.concatenate([one.tracks[name].nees for one in found])) < 3.6
    # Without the persistence of errors, the filter assumes independent ranges of a pair, and is overconfident.
    forgetful = replace(fitted, errors=replace(fitted.errors, lasting=None))
    alone = summarize(localize(flight, forgetful, Settings(seeds=1)))
    assert alone.nees > 3.6
    assert variance < 1.02 * alone.rmse_m["variance"]
    assert max(summary.spread_m.values()) < 0.02


@pytest.mark.slow
def test_fixed_variances_are_those_of_the_training_flight(flights, fitted):
    """With noise of 8 cm, values of the grid near it have the smallest error."""
    flight, exact = clean(beginning(flights["test1"], 8))
    found = fixed_std(exact, Settings(seeds=1), flight)
    assert found.std_m["calibrated"] in (0.07, 0.1, 0.14)
    assert "tuned on" in found.source
    known, train = fixed_std(fitted, Settings()), flights["train"].ranges
    assert known.std_m["raw"] == pytest.approx(np.std(train.raw_m - train.truth_m))
    assert known.std_m["calibrated"] < known.std_m["raw"]
    assert fixed_std(fitted, Settings(fixed_std_m=0.3)).std_m == {"raw": 0.3, "calibrated": 0.3}
    # Ranges without true distances give the same: the flight itself has no effect.
    assert localize(beginning(flight, 1), fitted, Settings(seeds=1))[0].fixed == known


def test_each_body_and_flight_has_noise_of_its_own(short):
    flight, known = clean(short)
    one = localize(flight, known, Settings(seeds=2, gate=1e9))[0]
    tracks = (one.tracks[name] for name in ("raw", "variance"))
    steps = [np.diff((track.estimate_m - track.truth_m)[:200], axis=0).ravel() for track in tracks]
    assert np.corrcoef(steps)[0, 1] > 0.8, "filters of a body see the same noise"
    drawn = [p.noisy(Settings(), 0)[1] - np.diff(p.place, axis=0, prepend=p.place[:1]) for p in problems(flight)]
    assert abs(np.corrcoef([noise[:200].ravel() for noise in drawn[:2]])[0, 1]) < 0.2, "600 values of other noise: 0.04"
    assert one.rmse_m["raw"][0] != one.rmse_m["raw"][1]
    again = localize(flight, known, Settings(seeds=1, seed=1, gate=1e9))[0]
    assert again.rmse_m["raw"][0] == one.rmse_m["raw"][1]


@pytest.mark.slow
@pytest.mark.parametrize("offset", [(0.0, -10.0, 0.0), (0.0, 0.0, 5.0)])
def test_a_wrong_start_is_left_within_two_seconds(flights, fitted, offset):
    for one in localize(beginning(flights["test1"], 4), fitted, Settings(seeds=1, initial_offset_m=offset)):
        for track in one.tracks.values():
            assert track_errors(track)[0] > 2
            assert track_errors(track, 2.0).max() < 0.8


@pytest.mark.slow
@pytest.mark.parametrize(("far_m", "offset"), [(3.0, (0.0, -10.0, 0.0)), (10.0, (0.0, 0.0, 5.0))])
def test_the_filter_recovers_after_wrong_ranges(flights, far_m, offset):
    flight, known = clean(beginning(flights["test1"], 12))
    # The ranges are wrong by metres with a stated decimetre, and the start agrees with no range. The gate rejects all
    # ranges until the filter restarts, first at the position of the wrong ranges, then at that of the right ones.
    early = flight.ranges.time_ns < flight.ranges.time_ns.min() + 2_000_000_000
    flight.ranges.raw_m[early] += far_m
    for one in localize(flight, known, Settings(seed=3, seeds=1, initial_offset_m=offset)):
        # Two seconds after the last wrong range it has recovered, and converges.
        wrong = track_errors(one.tracks["variance"], 4.0)
        assert wrong.max() < 1.0
        assert np.median(wrong) < 0.15


@pytest.mark.parametrize(("name", "value"), [("velocity_std_mps", 0.0), ("gate", float("nan")), ("seeds", 0)])
def test_wrong_settings_of_filters_are_refused(name, value):
    with pytest.raises(BadInputError, match=f"^`{name}`"):
        Settings(**{name: value})


def test_trajectories_are_written_in_tum_form_with_their_attitudes(short, tmp_path):
    flight, known = clean(beginning(short, 2))
    found = localize(flight, known, Settings(seeds=1))
    track, poses = found[0].tracks["raw"], flight.poses[flight.poses.body == found[0].body]
    write_tum(found, tmp_path)
    nearest = np.argmin(np.abs(poses.time_ns - track.time_ns[:, None]), axis=1)
    expected = np.hstack([track.estimate_m, poses.quaternion[nearest]])
    np.testing.assert_allclose(np.loadtxt(tmp_path / f"memory-{found[0].body}-raw.tum")[:, 1:], expected, atol=1e-6)
    assert len(list(tmp_path.glob("*.tum"))) == 3 * 4
    assert next(tmp_path.glob("*truth.tum")).read_text().startswith("# time")


def test_recordings_of_one_name_keep_their_own_trajectories(tmp_path):
    known = fit(sample_flight()).calibration
    write_tum([one for seed in (1, 2) for one in localize(sample_flight(60, seed=seed), known)], tmp_path)
    raw = sorted(path.name for path in tmp_path.glob("*-raw.tum"))
    assert raw == sorted(f"memory-robot{k}{end}-raw.tum" for k in (1, 2, 3) for end in ("", "_2"))
    assert (tmp_path / raw[0]).read_text() != (tmp_path / raw[1]).read_text()


def test_figures_state_omitted_bodies(short):
    found = localize(*clean(beginning(short, 1)), Settings(seeds=1))
    with style():
        (few,), (most,) = (rmse_bars(3.5, some).axes for some in (found, 2 * found))
    assert (few.get_xlabel(), len(few.get_xticks()), len(most.get_xticks())) == ("", 4, 6)
    assert most.get_xlabel().startswith("5 of 6 bodies")


# Information of a range for a filter, against draws of noise, detours and outliers.


STD = 0.1
ERRORS = RangeErrors(share=0.3, least_m=0.05, detour_m=0.3, outlier=0.02, outlier_m=2.0)
BOTH_SIDES = replace(ERRORS, share=np.array([0.3, 0.15]), detour_m=np.array([0.3, 0.2]))
LASTING = replace(ERRORS, known=0.2)
COUNT = 2_000_000


@pytest.fixture(scope="module", params=[ERRORS, BOTH_SIDES, LASTING])
def draws(request):
    errors, rng = request.param, np.random.default_rng(3)
    noise, kind = rng.normal(0, STD, COUNT), rng.random(COUNT)
    innovation = noise.copy()
    # In a difference of arrival, either reception may be reflected; if both are, one of the two counts.
    shares = np.atleast_1d(errors.share)
    ends = 0.98 * np.append(0, np.cumsum(shares) / shares.sum() * (1 - np.prod(1 - shares)))
    for sign, begin, end, detour in zip((1, -1), ends, ends[1:], np.atleast_1d(errors.detour_m), strict=False):
        reflected = (kind >= begin) & (kind < end)
        innovation[reflected] += sign * (0.05 + rng.exponential(detour, np.count_nonzero(reflected)))
        # If the detour lasts, the innovation has no information on the noise.
        lasting = kind < begin + (end - begin) * np.max(errors.known / errors.share)
        noise[reflected & lasting] = rng.normal(0, STD, np.count_nonzero(reflected & lasting))
    wild = kind > 0.98
    # The innovation of an outlier contains the uncertainty of the filter, and has no information on the noise.
    innovation[wild] = np.hypot(2.0, STD) * rng.normal(size=np.count_nonzero(wild))
    return errors, innovation, noise, wild


@pytest.mark.parametrize("value", [-0.3, -0.1, 0.0, 0.1, 0.2, 0.35, 0.7, 1.2, -1.0])
def test_mean_and_variance_of_the_noise_are_those_of_draws(draws, value):
    errors, innovation, noise, wild = draws
    near = np.abs(innovation - value) < 0.01
    update = mixture_update(np.array([value]), np.array([STD**2]), errors)
    count, inside = np.count_nonzero(near), noise[near]
    # Four standard errors, and the effect of the bin width.
    assert update.noise_m[0] == pytest.approx(inside.mean(), abs=4 * inside.std() / np.sqrt(count) + 0.004)
    assert update.variance_m2[0] == pytest.approx(inside.var(), rel=6 / np.sqrt(count) + 0.05, abs=1e-4)
    assert update.accepted[0] == (np.mean(wild[near]) < 0.5)
    assert np.exp(update.log_density[0]) == pytest.approx(count / COUNT / 0.02, rel=4 / np.sqrt(count) + 0.03)


def test_extreme_innovations_are_finite_and_rejected():
    update = mixture_update(np.array([-50.0, 1e3, 1e5]), np.full(3, STD**2), ERRORS)
    found = update.accepted, update.noise_m, update.variance_m2
    np.testing.assert_allclose(found, np.repeat([[False], [0], [STD**2]], 3, axis=1), rtol=1e-6, atol=1e-8)


def test_probabilities_of_reflections_agree_with_all_histories():
    """Compared with a sum over all histories of a renewal process, with densities by SciPy."""
    share, renewal_s, steps_s = 0.3, 0.5, np.array([0.0, 0.1, 0.05, 0.6, 0.02])
    innovation = np.array([0.05, 0.4, 0.9, 0.02, 0.25])
    direct, wild = norm(0, STD).pdf(innovation), 0.02 * norm(0, np.hypot(2.0, STD)).pdf(innovation)
    reflected = exponnorm(0.3 / STD, 0.05, STD).pdf(innovation)
    density, kept = 0.98 * np.stack([direct, reflected]) + wild, np.exp(-steps_s / renewal_s)
    tracked, pair = Reflections(renewal_s, (1, 2)), np.array([1])
    for k in range(len(innovation)):
        found = np.zeros(2)
        for history in product((0, 1), repeat=k + 1):
            odds = [(1 - share, share)[one] for one in history]
            moved = [kept[j] * (history[j] == history[j - 1]) + (1 - kept[j]) * odds[j] for j in range(1, k + 1)]
            found[history[-1]] += odds[0] * np.prod(moved) * np.prod(density[history, range(k + 1)])
        tracked.decay(float(steps_s[k]))
        told = tracked.weigh(
            innovation[[k]], np.array([STD**2]), replace(ERRORS, share=np.array([share])), pair, np.ones(1, bool)
        )
        assert told.reflected[0, 0] == pytest.approx(found[1] / found.sum(), rel=1e-9)
    assert not tracked.lasting[0, 0].any()


@pytest.mark.slow
def test_lasting_reflections_do_not_mislead_the_filter():
    """Between metal racks, half of the ranges of a body are metres too long, for seconds on end; 3 is right.

    A filter that assumes independent ranges of a pair has a NEES of 24 here, and an error of 20 cm.
    """
    first, second = (
        simulate(load("hall_with_metal/hall", {"run.seed": seed, "run.duration_s": 40.0})) for seed in (592, 692)
    )
    found = localize(second, fit(first), Settings(seeds=1))
    assert np.mean(np.concatenate([one.tracks["robust"].nees for one in found])) < 10
    assert summarize(found).rmse_m["robust"] < 0.16
