"""The joint fit compared with an independent optimiser, the recipe of the paper, groups of tags, and smooth curves."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calib import Calibration, UnanswerableError, fit
from calib.calibration.power_curves import basis, curvature, lifted_power
from calib.data.ranges import without_static
from calib.estimator import known_distances
from tests.calib.synthetic import DELAYS_NS, about_their_mean, bias_m, ranges


@pytest.mark.slow
def test_the_joint_fit_is_better_if_power_depends_on_the_pair():
    # A fit of delays alone takes the effect of a pair's typical power for a delay.
    slope = 0.2
    r = ranges(12_000, bias=lambda lifted: slope * lifted)
    low = (r.initiator == 1) | (r.target == 1)
    fpp = [np.where(low, power - 6, power) for power in (r.fpp1_dbm, r.fpp2_dbm)]
    before, after = (lifted_power(one, two, "mean-of-lifted", -82.0) for one, two in ((r.fpp1_dbm, r.fpp2_dbm), fpp))
    r = replace(r, fpp1_dbm=fpp[0], fpp2_dbm=fpp[1], raw_m=r.raw_m + slope * (after - before))
    fits = (fit(r, sequential=sequential).calibration for sequential in (False, True))
    together, after = (np.std(about_their_mean(found, DELAYS_NS)[0]) for found in fits)
    assert together < 0.02 < after


def grouped(r, groups):
    """Give tags of the second group a bias of the opposite sign."""
    other = [0.5 * np.isin(ids, groups["second"]) for ids in (r.initiator, r.target)]
    lifted = lifted_power(r.fpp1_dbm, r.fpp2_dbm, "mean-of-lifted", -82.0)
    return replace(r, raw_m=r.raw_m - 2 * (other[0] + other[1]) * bias_m(lifted))


def test_groups_of_tags_get_their_own_curves():
    groups = {"first": (1, 2), "second": (3, 7)}
    c = fit(grouped(ranges(30_000), groups), groups=groups).calibration
    grid = np.linspace(*c.bias_curve.range, 200)
    for name, sign in (("first", 1), ("second", -1)):
        assert np.std(c.groups[name].bias_curve(grid) - (sign * bias_m(grid))) < 0.006, name
        assert c.groups[name].bias_curve(np.array([1.0]))[0] == pytest.approx(0, abs=1e-9)
    assert (Calibration.from_json(c.to_json()), json.loads(c.to_json())["schema_version"]) == (c, 2)
    # A range between the groups has the mean of both curves, which is zero here.
    r = grouped(ranges(3000, seed=8), groups)
    applied = c.apply(r)
    assert np.median(np.abs(np.median(applied.corrected_m - r.truth_m))) < 0.02
    mixed = np.isin(r.initiator, (1, 2)) != np.isin(r.target, (1, 2))
    assert np.std((applied.delay_corrected_m - applied.corrected_m)[mixed]) < 0.006


@pytest.mark.parametrize("settings", [{}, {"fixed_ns": {1: -0.3}}, {"constants": "pair"}])
def test_a_reference_power_moves_a_constant_and_corrects_ranges_alike(settings):
    r = ranges(600)
    if settings.get("fixed_ns"):
        # For a single pair, the other delay compensates the constant.
        r = r[(r.initiator == 1) & (r.target == 2)]
    plain, stated = (fit(r, sequential=True, reference_power_dbm=at, **settings).calibration for at in (None, -84.0))
    assert stated.bias_curve(np.array([10**-0.2]))[0] == pytest.approx(0, abs=1e-9)
    assert plain.bias_curve(np.array([10**-0.2]))[0] != pytest.approx(0, abs=1e-3)
    np.testing.assert_allclose(stated.apply(r).corrected_m, plain.apply(r).corrected_m, atol=1e-6)


def test_the_band_contains_the_curve():
    inside = []
    for seed in range(3):
        c = fit(ranges(4000, seed=seed)).calibration
        grid = np.linspace(*c.bias_curve.range, 50)
        wrong = c.bias_curve(grid) - bias_m(grid)
        inside.append(np.abs(wrong - wrong.mean()) < 1.96 * np.asarray(c.band(grid, "bias"), dtype=float))
    # 150 points, of which about eight per curve are independent: 95 % within 5 % on either side, and a little more for
    # the reflections that a Cauchy loss does not remove.
    assert np.mean(inside) > 0.88


def test_curvature_is_the_integral_of_squared_second_derivatives():
    knots = np.concatenate([[0.0] * 4, [0.3, 0.9], [2.0] * 4])
    # x^3 has the second derivative 6 x, whose square has the integral 96 over (0, 2); lengths are in spans of 2.
    fine = np.linspace(0, 2, 400)
    coefficients = np.linalg.lstsq(basis(fine, knots), fine**3, rcond=None)[0]
    assert coefficients @ curvature(knots) @ coefficients == pytest.approx(96 * 2**3, rel=1e-9)


def test_static_spans_are_left_out():
    r = ranges(6000)
    still = r.time_ns < 10_000_000_000
    moving = without_static(replace(r, truth_m=np.where(still, 2.0, r.truth_m)))
    assert len(moving) == np.count_nonzero(~still)
    assert moving.excluded == {"static": np.count_nonzero(still)}
    with pytest.raises(UnanswerableError, match="nothing moves"):
        without_static(replace(r, truth_m=np.full(len(r), 2.0)))


def test_power_that_varies_with_distance_causes_a_warning():
    r = ranges(5000)
    assert not any("confounded" in warning for warning in fit(r).warnings)
    rng = np.random.default_rng(1)
    # Lifted power decreases linearly with distance: a curve over power may be an error by distance.
    power = -82 + 10 * np.log10(3.0 - 0.45 * r.truth_m + rng.normal(size=(2, len(r))) * 0.01)
    found = fit(replace(ranges(5000, bias=lambda lifted: 0.1 * lifted), fpp1_dbm=power[0], fpp2_dbm=power[1]))
    assert any("confounded" in warning for warning in found.warnings)
    assert found.calibration.provenance["warnings"] == found.warnings


def test_single_sided_ranges_and_missing_ones_are_warned_of():
    r = ranges(3000)
    found = fit(replace(r, protocol=np.full(len(r), "ss"), excluded={"no true distance": 1000}))
    assert any("single-sided" in warning for warning in found.warnings)
    assert any("25 % of the exchanges were left out: no true distance" in warning for warning in found.warnings)


def test_a_search_that_excludes_a_pair_is_rejected(monkeypatch):
    found_by, r = known_distances.fit_likelihood, ranges(2000)
    assert fit(r).calibration.loss == "mixture"

    def lost(model, *words):
        found = found_by(model, *words)
        # 75 cm in all ranges of a tag: farther from the robust start than reflections shift a median.
        return replace(found, residuals=found.residuals + 0.75 * (model.ranges.initiator == 1))

    monkeypatch.setattr(known_distances, "fit_likelihood", lost)
    assert fit(r).calibration.loss == "cauchy"
    assert any("treated all ranges of a pair as reflected" in warning for warning in fit(r, loss="mixture").warnings)
