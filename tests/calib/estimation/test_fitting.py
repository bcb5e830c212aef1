"""Delays and curves together: planted truth, the gauge, and what cannot be answered."""

from dataclasses import replace

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

from calib.errors import UnanswerableError
from calib.fitting.fitting import fit
from tests.calib.synthetic import DELAYS_NS, bias_m, ranges
from uwblink.ticks import SPEED_OF_LIGHT


def test_planted_delays_and_curve_come_back():
    r = ranges(20_000)
    before = r.raw_m.copy()
    result = fit(r)
    c = result.calibration
    np.testing.assert_array_equal(r.raw_m, before)
    np.testing.assert_allclose(result.residuals_m, c.apply(r).corrected_m - r.truth_m, atol=1e-9)
    shift = np.mean([c.delays_ns[t] - d for t, d in DELAYS_NS.items()])
    for tag, delay in DELAYS_NS.items():
        # 3300 ranges a pair at 5 cm leave 5 ps of standard error in a delay; four of those.
        assert c.delays_ns[tag] - shift == pytest.approx(delay, abs=0.020)
    grid = np.linspace(*c.bias_curve.range, 200)
    wrong = c.bias_curve(grid) - shift * 1e-9 * SPEED_OF_LIGHT - bias_m(grid)
    assert np.sqrt(np.mean(wrong**2)) < 0.004
    assert c.sigma_curve(np.array([0.2, 0.5, 0.9])) == pytest.approx(0.05, rel=0.06)


@pytest.mark.parametrize(("reference_dbm", "lifted"), [(None, 1.0), (-84.0, 10**-0.2)])
def test_curve_is_zero_at_the_reference_power_and_delays_are_those_for_it(reference_dbm, lifted):
    c = fit(ranges(20_000), reference_power_dbm=reference_dbm).calibration
    assert c.bias_curve(np.array([lifted]))[0] == pytest.approx(0, abs=1e-9)
    constant = bias_m(lifted) / SPEED_OF_LIGHT * 1e9
    for tag, delay in DELAYS_NS.items():
        # What the planted curve is there counts for a delay: a range is corrected by half of two of them.
        assert abs(c.delays_ns[tag] - (delay - constant)) < 3.5 * c.delays_std_ns[tag]


def test_the_same_boards_at_fainter_powers_get_the_same_delays():
    loud, faint = ranges(20_000, seed=3), ranges(20_000, seed=4)
    faint = replace(faint, fpp1_dbm=faint.fpp1_dbm - 4, fpp2_dbm=faint.fpp2_dbm - 4)
    lifted = [np.mean(10 ** ((np.array([r.fpp1_dbm, r.fpp2_dbm]) + 82) / 10), axis=0) for r in (loud, faint)]
    faint = replace(faint, raw_m=faint.raw_m - bias_m(10**0.4 * lifted[1]) + bias_m(lifted[1]))
    first, second = (fit(r, reference_power_dbm=-86.0).calibration for r in (loud, faint))
    for tag in DELAYS_NS:
        std = np.hypot(first.delays_std_ns[tag], second.delays_std_ns[tag])
        assert abs(first.delays_ns[tag] - second.delays_ns[tag]) < 3.5 * std
        # And that is no empty claim: the intervals are those of delays known to some hundredths of a nanosecond.
        assert std < 0.03


@pytest.mark.parametrize(("reference_dbm", "nearest"), [(-60.0, -80.8), (-110.0, -94.2)])
def test_a_reference_power_that_was_not_recorded_is_said(reference_dbm, nearest):
    found = fit(ranges(600), reference_power_dbm=reference_dbm)
    (said,) = [warning for warning in found.warnings if "reference power" in warning]
    assert f"{reference_dbm} dBm" in said
    assert f"{nearest} dBm" in said


def test_ranges_left_out_as_static_were_left_out_on_purpose():
    some = ranges(600)
    asked, missing = (fit(replace(some, excluded={why: 400})) for why in ("static", "no power"))
    assert not [warning for warning in asked.warnings if "left out" in warning]
    assert [warning for warning in missing.warnings if "left out" in warning and "no power" in warning]


@pytest.mark.parametrize(("by_m", "way"), [(0.3, "longer"), (-0.3, "shorter")])
def test_the_way_in_which_a_pair_reads_too_long_is_said(by_m, way):
    some = ranges(3000, tail=0)
    first = np.where(np.arange(len(some)) % 12 < 6, some.initiator, some.target)
    second = some.initiator + some.target - first
    off = by_m * ((first == 2) & (second == 7))
    found = fit(replace(some, initiator=first, target=second, raw_m=some.raw_m + off))
    (said,) = [warning for warning in found.warnings if warning.startswith("pair 2-7") and "initiates" in warning]
    assert f"{way} if tag 2 initiates" in said


def test_curves_are_held_constant_and_flagged_beyond_their_range():
    c = fit(ranges()).calibration
    low, high = c.bias_curve.range
    outside = np.array([-5.0, low - 1e-6, high + 1e-6, 50.0])
    np.testing.assert_allclose(c.bias_curve(outside), c.bias_curve(np.array([low, low, high, high])), atol=1e-9)
    assert not c.bias_curve.inside(outside).any()
    assert np.all(c.sigma_curve(np.linspace(-5, 50, 500)) > 0)


@pytest.mark.parametrize(
    ("loss", "lift"),
    [
        *((loss, "mean-of-lifted") for loss in ("cauchy", "huber", "soft_l1", "l2", "mixture")),
        ("cauchy", "lift-of-mean"),
        ("mixture", "lift-of-mean"),
    ],
)
def test_every_option_fits(loss, lift):
    c = fit(ranges(600, tail=0.02), loss=loss, lift=lift).calibration
    assert (c.loss, c.lift) == (loss, lift)
    assert np.all(np.isfinite(list(c.delays_ns.values())))


def test_what_cannot_be_answered_says_why():
    with pytest.raises(UnanswerableError, match="too few"):
        fit(ranges(60))


@pytest.mark.slow
def test_the_mixture_knows_delays_better_than_a_loss_does():
    errors: dict[str, list[float]] = {"cauchy": [], "mixture": []}
    for seed in range(4):
        r = ranges(6000, tail=0.3, seed=seed)
        for loss, found in errors.items():
            c = fit(r, loss=loss).calibration
            shift = np.mean([c.delays_ns[t] - d for t, d in DELAYS_NS.items()])
            found += [float(c.delays_ns[t] - shift - d) for t, d in DELAYS_NS.items()]
    spread = {loss: np.std(found) for loss, found in errors.items()}
    assert spread["mixture"] < 0.9 * spread["cauchy"]


@pytest.mark.slow
def test_the_mixture_s_standard_errors_hold():
    scores = []
    for seed in range(16):
        c = fit(ranges(1500, seed=seed), loss="mixture").calibration
        wrong = np.array([c.delays_ns[t] - d for t, d in DELAYS_NS.items()])
        centre = np.eye(len(wrong)) - 1 / len(wrong)
        std = np.sqrt(np.diag(centre @ np.array(c.uncertainty.delays_ns2) @ centre))
        scores.append((wrong - wrong.mean()) / std)
    # 64 scores with three independent ones in four know their spread to 10 %; intervals may be a little wide.
    assert 0.75 < np.std(scores) < 1.2


def test_a_pinned_delay_stays_and_determines_a_single_pair():
    r = ranges(6000)
    pair = r[(r.initiator == 1) & (r.target == 2)]
    assert "`fixed_ns`" in fit(pair).warnings[0]
    # The curve is zero at its reference; the planted one is not, and the other delay makes up for that.
    c = fit(pair, fixed_ns={1: DELAYS_NS[1]}).calibration
    assert c.delays_ns[1] == DELAYS_NS[1]
    grid = np.linspace(*c.bias_curve.range, 400)
    both = 0.5 * (c.delays_ns[2] - DELAYS_NS[2]) * 1e-9 * SPEED_OF_LIGHT
    assert np.sqrt(np.mean((c.bias_curve(grid) - both - bias_m(grid)) ** 2)) < 0.01


@pytest.mark.parametrize("loss", ["mixture", "cauchy", "l2"])
def test_ranges_without_any_error_have_no_delays_and_no_curve(loss):
    r = ranges(600)
    found = fit(replace(r, raw_m=r.truth_m), loss=loss).calibration
    assert max(abs(d) for d in found.delays_ns.values()) < 1e-6
    low, high = found.bias_curve.range
    np.testing.assert_allclose(found.bias_curve(np.linspace(low, high, 20)), 0, atol=1e-6)


@pytest.mark.slow
def test_a_fit_is_the_same_to_the_last_digit_whatever_the_number_of_threads():
    # Sums of several threads end in other digits than those of one.
    found = []
    for threads in (1, 4):
        with threadpool_limits(threads, user_api="blas"):
            found.append(fit(ranges(6000)).calibration.to_json())
    assert found[0] == found[1]


def test_ranges_far_too_short_are_no_inliers_and_are_counted():
    some = ranges(n=1200, noise_m=0.05, tail=0)
    short = np.arange(len(some)) % 40 == 0
    found = fit(replace(some, raw_m=some.raw_m - 1.5 * short))
    rows = np.isin(found.ranges.time_ns, some.time_ns[short])
    assert not found.inliers[rows].any()
    assert np.mean(found.inliers[~rows]) > 0.98
    assert found.calibration.provenance["inliers"] == np.count_nonzero(found.inliers)


def test_a_scale_that_is_given_is_the_scale_of_the_loss():
    some = ranges(n=600)
    assert fit(some, loss="cauchy", scale_ns=0.3).calibration.scale_ns == pytest.approx(0.3)
    # Far beyond all errors, Cauchy's loss is that of least squares.
    wide, squares = fit(some, loss="cauchy", scale_ns=1000.0), fit(some, loss="l2")
    for tag in DELAYS_NS:
        assert wide.calibration.delays_ns[tag] == pytest.approx(squares.calibration.delays_ns[tag], abs=1e-4)


def test_what_is_not_known_of_the_smoothness_is_in_the_band_of_the_curve(monkeypatch):
    some = ranges(n=3000)
    whole, likely = (fit(some, loss=loss).calibration.uncertainty.bias_m2 for loss in ("cauchy", "mixture"))
    assert 0.5 < np.trace(whole) / np.trace(likely) < 4
    monkeypatch.setattr("calib.estimator.covariance.of_weights", lambda _, keep: np.zeros((len(keep),) * 2))
    without = fit(some, loss="cauchy").calibration.uncertainty.bias_m2
    assert np.trace(whole) > 1.02 * np.trace(without)
