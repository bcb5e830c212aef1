"""Delays and curves together: planted values, the gauge, and data that do not determine the result."""

import math
import re
from dataclasses import replace
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib import pyplot
from threadpoolctl import threadpool_limits

import calib
from calib.calibration.power_curves import basis, curvature
from calib.data.ranges import without_static
from calib.estimator import known_distances
from calib.estimator.losses import LOSSES, register_loss
from calib.findings import Finding
from tests.calib.synthetic import DELAYS_NS, about_their_mean, bias_m, design, lifted, ranges
from uwblink.ticks import SPEED_OF_LIGHT


def test_planted_delays_and_curve_are_found():
    r = ranges(20_000)
    result = calib.fit(r)
    c = result.calibration
    np.testing.assert_array_equal(r.raw_m, ranges(20_000).raw_m)
    np.testing.assert_allclose(result.residuals_m, c.apply(r).corrected_m - r.truth_m, atol=1e-9)
    # 3300 ranges per pair at 5 cm give a standard error of 5 ps of a delay; four of those.
    assert np.abs(about_their_mean(c, DELAYS_NS)[0]).max() < 0.020
    shift = np.mean([c.delays_ns[t] - d for t, d in DELAYS_NS.items()])
    grid = np.linspace(*c.bias_curve.range, 200)
    assert np.sqrt(np.mean((c.bias_curve(grid) - shift * 1e-9 * SPEED_OF_LIGHT - bias_m(grid)) ** 2)) < 0.004
    assert c.sigma_curve(np.array([0.2, 0.5, 0.9])) == pytest.approx(0.05, rel=0.06)


@pytest.mark.parametrize(("reference_dbm", "reference"), [(None, 1.0), (-84.0, 10**-0.2)])
def test_curve_is_zero_at_the_reference_power_and_delays_are_those_for_it(reference_dbm, reference):
    c = calib.fit(ranges(20_000), reference_power_dbm=reference_dbm).calibration
    assert c.bias_curve(np.array([reference]))[0] == pytest.approx(0, abs=1e-9)
    for tag, delay in DELAYS_NS.items():
        # The value of the planted curve there counts as a delay: a range is corrected by half of two delays.
        expected = delay - bias_m(reference) / SPEED_OF_LIGHT * 1e9
        assert c.delays_ns[tag] == pytest.approx(expected, abs=3.5 * c.delays_std_ns[tag])


@pytest.mark.parametrize(("reference_dbm", "nearest"), [(-60.0, -80.8), (-110.0, -94.2)])
def test_an_unrecorded_reference_power_has_a_warning(reference_dbm, nearest):
    found = calib.fit(ranges(600), reference_power_dbm=reference_dbm)
    (said,) = [warning for warning in found.warnings if "reference power" in warning]
    assert [f"{power} dBm" in said for power in (reference_dbm, nearest)] == [True, True]


@pytest.mark.parametrize("settings", [{"fixed_ns": {1: -0.3}}, {"delays_only": True}, {"sequential": True}, {}])
def test_a_warning_states_that_a_reference_power_has_no_effect(settings):
    texts = calib.fit(ranges(n=2000), reference_power_dbm=-85.0, **settings).warnings
    without_effect = "fixed_ns" in settings or "delays_only" in settings
    assert any("reference power has no effect" in text for text in texts) == without_effect


def test_ranges_left_out_have_a_warning_unless_they_are_static():
    some = ranges(600)
    static, missing = (calib.fit(replace(some, excluded={why: 200})).warnings for why in ("static", "no power"))
    assert not [warning for warning in static if "left out" in warning]
    assert [warning for warning in missing if "25 % of the exchanges were left out: no power" in warning]


def test_single_sided_ranges_without_reply_times_have_a_warning():
    found = calib.fit(replace(ranges(3000), protocol=np.full(3000, "ss")))
    assert [warning for warning in found.warnings if "single-sided ranges without reply times" in warning]


@pytest.mark.parametrize(("by_m", "way"), [(0.3, "longer"), (-0.3, "shorter")])
def test_the_sign_of_a_pairs_error_is_stated(by_m, way):
    some = ranges(3000, tail=0)
    first = np.where(np.arange(len(some)) % 12 < 6, some.initiator, some.target)
    second = some.initiator + some.target - first
    off = by_m * ((first == 2) & (second == 7))
    found = calib.fit(replace(some, initiator=first, target=second, raw_m=some.raw_m + off))
    (named,) = [one for one in found.findings if one.evidence.startswith("pair 2-7") and "initiates" in one.evidence]
    assert f"{way} if tag 2 initiates" in named.evidence
    assert 0 < (named.p_value or 0) < 1e-6


@pytest.mark.slow
def test_the_mixture_estimates_delays_better_than_a_loss():
    worlds = [ranges(6000, tail=0.3, seed=seed) for seed in range(4)]
    cauchy, mixture = (
        np.std([about_their_mean(calib.fit(r, loss=loss).calibration, DELAYS_NS)[0] for r in worlds])
        for loss in ("cauchy", "mixture")
    )
    assert mixture < 0.9 * cauchy


@pytest.mark.slow
def test_standard_errors_of_the_mixture_match_the_spread():
    fits = (calib.fit(ranges(1500, seed=seed), loss="mixture").calibration for seed in range(16))
    scores = [np.divide(*about_their_mean(found, DELAYS_NS)) for found in fits]
    # 64 scores, with three independent ones in four, determine their spread to 10 %; intervals may be slightly wide.
    assert 0.75 < np.std(scores) < 1.2


def test_a_pinned_delay_stays_and_determines_a_single_pair():
    r = ranges(6000)
    pair = r[(r.initiator == 1) & (r.target == 2)]
    assert "`fixed_ns`" in calib.fit(pair).warnings[0]
    # The curve is zero at its reference; the planted one is not, and the other delay compensates that.
    c = calib.fit(pair, fixed_ns={1: DELAYS_NS[1]}).calibration
    assert c.delays_ns[1] == DELAYS_NS[1]
    grid, both = np.linspace(*c.bias_curve.range, 400), 0.5 * (c.delays_ns[2] - DELAYS_NS[2]) * 1e-9 * SPEED_OF_LIGHT
    assert np.sqrt(np.mean((c.bias_curve(grid) - both - bias_m(grid)) ** 2)) < 0.01


@pytest.mark.parametrize("loss", ["mixture", "cauchy", "l2"])
def test_ranges_without_any_error_have_no_delays_and_no_curve(loss):
    r = ranges(600)
    found = calib.fit(replace(r, raw_m=r.truth_m), loss=loss).calibration
    assert max(abs(d) for d in found.delays_ns.values()) < 1e-6
    np.testing.assert_allclose(found.bias_curve(np.linspace(*found.bias_curve.range, 20)), 0, atol=1e-6)


@pytest.mark.slow
def test_a_fit_is_the_same_to_the_last_digit_whatever_the_number_of_threads():
    # Sums by several threads have other last digits than those by one.
    with threadpool_limits(4, user_api="blas"):
        found = calib.fit(ranges(6000)).calibration
    with threadpool_limits(1, user_api="blas"):
        assert calib.fit(ranges(6000)).calibration == found


def test_ranges_far_too_short_are_counted_as_outliers():
    some, short = ranges(n=1200, noise_m=0.05, tail=0), np.arange(1200) % 40 == 0
    found = calib.fit(replace(some, raw_m=some.raw_m - 1.5 * short))
    rows = np.isin(found.ranges.time_ns, some.time_ns[short])
    assert not found.inliers[rows].any()
    assert np.mean(found.inliers[~rows]) > 0.98
    assert found.calibration.provenance["inliers"] == np.count_nonzero(found.inliers)


def test_a_scale_that_is_given_is_the_scale_of_the_loss():
    some = ranges(n=600)
    assert calib.fit(some, loss="cauchy", scale_ns=0.3).calibration.scale_ns == pytest.approx(0.3)
    # Far above all errors, the Cauchy loss is that of least squares.
    wide, squares = calib.fit(some, loss="cauchy", scale_ns=1000.0), calib.fit(some, loss="l2")
    assert wide.calibration.delays_ns == pytest.approx(squares.calibration.delays_ns, abs=1e-4)


def test_the_band_of_the_curve_includes_the_uncertain_smoothness(monkeypatch):
    some = ranges(n=3000)
    whole, likely = (calib.fit(some, loss=loss).calibration.uncertainty.bias_m2 for loss in ("cauchy", "mixture"))
    assert 0.5 < np.trace(whole) / np.trace(likely) < 4
    monkeypatch.setattr("calib.estimator.covariance.of_weights", lambda _, keep: np.zeros((len(keep),) * 2))
    assert np.trace(whole) > 1.02 * np.trace(calib.fit(some, loss="cauchy").calibration.uncertainty.bias_m2)


# Parameters of a fit: each error names the parameter, before the computation.


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("loss", "arctan"),
        ("reference_power_dbm", math.nan),
        ("reference_power_dbm", 1e9),
        ("scale_ns", -1),
        ("scale_ns", 0.0),
        ("scale_ns", math.nan),
        ("scale_ns", "auto"),
        ("lift", "up"),
        ("between_m", -1.0),
        ("constants", "board"),
        ("alpha_dbm", math.inf),
        ("fixed_ns", {1: math.nan}),
        ("fixed_ns", {1.5: 0.1}),
        ("fixed_ns", {99: 0.1}),
        ("groups", {"a": [1, 2], "b": [2, 3, 7]}),
        ("groups", {"a": "12"}),
        ("groups", {"a": []}),
        ("groups", {"a": [1, 2]}),
        ("groups", {"a": [1, 2, 3, 7], "b": [8]}),
        ("sequential", True),  # of the mixture, whose parameters follow
    ],
)
def test_wrong_settings_are_named(parameter, value):
    with pytest.raises(calib.BadInputError, match=rf"(?s)^`{parameter}`: ((?!--).)*$"):
        calib.fit(ranges(300), **{"loss": "mixture", parameter: value})


def test_constants_of_pairs_exclude_known_delays():
    """The constants of pairs would contain the known delays a second time."""
    known = calib.fit(ranges(300)).calibration
    for given in ({"fixed_ns": {1: -0.3}}, {"delays_from": known}):
        with pytest.raises(calib.BadInputError, match=r"^`constants`: "):
            calib.fit(ranges(300), constants="pair", **given)


def test_numpy_numbers_are_numbers():
    plain: dict[str, Any] = {"scale_ns": 0.1, "fixed_ns": {1: -0.36}, "groups": {"a": (1, 2), "b": (3, 7)}}
    numbers: dict[str, Any] = {
        "scale_ns": np.float64(0.1),
        "fixed_ns": {np.int64(1): np.float64(-0.36)},
        "groups": {"a": np.array([1, 2]), "b": np.array([3, 7])},
    }
    one, other = (calib.fit(ranges(600), loss="cauchy", **settings).calibration for settings in (plain, numbers))
    assert one.to_json() == other.to_json()


# A new tag from calibrated tags.


@pytest.fixture(scope="module")
def known():
    r = ranges(8000)
    return calib.fit(r[(r.initiator != 7) & (r.target != 7)]).calibration


def test_the_delay_of_a_new_tag_is_found_and_others_stay(known):
    added = calib.add_tag(ranges(3000, seed=5), known, 7).calibration
    assert {t: d for t, d in added.delays_ns.items() if t != 7} == known.delays_ns
    assert added.bias_curve == known.bias_curve
    # The fitted delays of the others have a common shift with the curve, and so does the new one.
    shift = np.mean([known.delays_ns[t] - DELAYS_NS[t] for t in known.delays_ns])
    assert added.delays_ns[7] - shift == pytest.approx(DELAYS_NS[7], abs=0.05)
    assert 0.002 < added.delays_std_ns[7] < 0.03


@pytest.mark.parametrize(
    ("tag", "loss", "changes", "error", "said"),
    [
        (-1, "l2", {}, calib.BadInputError, "`tag`: found -1"),
        (7, "arctan", {}, calib.BadInputError, "`loss`"),
        (1, "l2", {}, calib.BadInputError, "`tag`"),
        (42, "l2", {}, calib.BadInputError, "has no ranges"),
        (7, "l2", {"delays_ns": {99: 0.0}}, calib.UnanswerableError, "too few"),
    ],
)
def test_new_tags_that_cannot_be_added_are_refused(known, tag, loss, changes, error, said):
    with pytest.raises(error, match=said):
        calib.add_tag(ranges(1200), replace(known, **changes), tag, loss)


# Robust losses: their weights and slopes, and registered losses.


@pytest.mark.parametrize("loss", ["cauchy", "huber", "soft_l1", "l2"])
def test_losses_pass_the_check_of_registered_ones(loss):
    """Its slopes are compared with differences of the score."""
    register_loss("again", LOSSES[loss].weights)
    LOSSES.remove("again")


def welsch(u):
    weight = np.exp(-(u**2) / 2)
    return weight, weight * (1 - u**2)


@pytest.fixture
def own_loss():
    register_loss("welsch", welsch)
    yield "welsch"
    LOSSES.remove("welsch")


def test_registered_losses_are_fitted(own_loss):
    r = ranges(3000)
    found, alone = calib.fit(r, loss=own_loss).calibration, calib.fit(r, loss=own_loss, scale_ns=0.1, delays_only=True)
    assert found.loss == "welsch"
    matrix, u = design(r, r.tags()), alone.residuals_m / (0.1 * SPEED_OF_LIGHT * 1e-9)
    # At the optimum of this loss only, its scores sum to zero.
    assert np.abs(matrix.T @ (u * np.exp(-(u**2) / 2))).max() < 0.1 * np.abs(matrix.T @ (u / (1 + u**2))).max()
    # A common shift of all is the constant of the curve; 50 ps are five standard errors.
    np.testing.assert_allclose(about_their_mean(found, DELAYS_NS)[0], 0, atol=0.05)


@pytest.mark.parametrize(
    ("name", "loss", "fragment"),
    [
        ("cauchy", welsch, "this name is reserved"),
        ("mixture", welsch, "this name is reserved"),
        ("wrong-slope", lambda u: (1 / (1 + u**2), 1 / (1 + u**2)), "slope at u"),
        ("one-array", lambda u: 1 / (1 + u**2), "two arrays"),
        ("numbers", lambda u: (1.0, 1.0), "one for each"),
        ("half", lambda u: (0.5 + 0 * u, 0.5 + 0 * u), "u = 0"),
        ("nan", lambda u: (u / 0.0 * 0, u), "finite"),
    ],
)
def test_contradicting_losses_are_refused(name, loss, fragment):
    with np.errstate(all="ignore"), pytest.raises(calib.BadInputError, match=fragment):
        register_loss(name, loss)
    assert name not in set(LOSSES) - {"cauchy"}


def test_a_registered_loss_is_replaced_only_when_asked(own_loss):
    with pytest.raises(calib.BadInputError, match="already registered"):
        register_loss(own_loss, welsch)
    register_loss(own_loss, LOSSES["cauchy"].weights, replace=True)
    np.testing.assert_array_equal(LOSSES[own_loss].weights(np.ones(1)), LOSSES["cauchy"].weights(np.ones(1)))


# The result of a fit prints on a screen, plots itself and saves.


matplotlib.use("Agg")


@pytest.fixture(scope="module")
def result():
    return replace(calib.fit(ranges(2000)), findings=[Finding("dog", "<b>beware</b> of the dog", "", None)])


def test_results_print_on_a_screen(result):
    lines = repr(result).splitlines()
    assert len(lines) < 20
    assert max(map(len, lines)) < 120
    for tag, delay in result.calibration.delays_ns.items():
        (line,) = [line for line in lines if line.split()[:1] == [str(tag)]]
        assert re.search(rf"\{delay:+.4f} +± {1.959964 * result.calibration.delays_std_ns[tag]:.4f}", line)
    assert "2000 ranges of synthetic: converged after" in lines[0]
    assert lines[-1] == "warning: <b>beware</b> of the dog"
    assert repr(result.calibration) in repr(result)


def test_a_calibration_prints_as_its_table(result):
    known = result.calibration
    many = replace(known, delays_ns=dict.fromkeys(range(500), 0.1))
    for one, said in (
        (known, f"{100 * known.bias_curve(np.array(known.bias_curve.range))[0]:+.1f}"),
        (replace(known, delays_std_ns=dict.fromkeys(DELAYS_NS, np.inf)), "undetermined"),
        (replace(known, delays_std_ns=dict.fromkeys(DELAYS_NS, 0.0)), "pinned"),
        (many, "460 more"),
    ):
        assert said in repr(one)
    assert (len(repr(known)) < 1500, len(repr(many).splitlines()) < 60) == (True, True)


def test_html_is_escaped(result):
    page = result._repr_html_()
    assert [page.count(part) for part in ("<b>beware", "&lt;b&gt;beware", "data:image/png")] == [0, 1, 1]
    assert page.count("<tr>") == page.count("</tr>") == 1 + len(DELAYS_NS) + 3


@pytest.mark.parametrize("name", ["plot_bias", "plot_sigma", "plot_residuals", "plot_delays"])
def test_results_draw_into_axes(result, name):
    axes, draw = pyplot.figure().subplots(), getattr(result, name)
    assert draw(axes) is axes
    assert axes.get_xlabel()
    assert axes.get_legend()
    assert draw().figure in [pyplot.figure(number) for number in pyplot.get_fignums()]
    pyplot.close("all")


# The recipe of the paper, groups of tags, smooth curves, and a search that goes astray.


@pytest.mark.slow
def test_the_joint_fit_is_better_if_power_depends_on_the_pair():
    # A fit of delays alone takes the effect of a pair's typical power for a delay.
    slope = 0.2
    r = ranges(12_000, bias=lambda lifted: slope * lifted)
    fpp = np.array([r.fpp1_dbm, r.fpp2_dbm])
    lower = fpp - 6 * ((r.initiator == 1) | (r.target == 1))
    r = replace(r, fpp1_dbm=lower[0], fpp2_dbm=lower[1], raw_m=r.raw_m + slope * (lifted(*lower) - lifted(*fpp)))
    fits = (calib.fit(r, sequential=sequential).calibration for sequential in (False, True))
    together, after = (np.std(about_their_mean(found, DELAYS_NS)[0]) for found in fits)
    assert together < 0.02 < after


def grouped(r, groups):
    """Give tags of the second group a bias of the opposite sign."""
    others = np.isin([r.initiator, r.target], groups["second"]).sum(axis=0)
    return replace(r, raw_m=r.raw_m - others * bias_m(lifted(r.fpp1_dbm, r.fpp2_dbm)))


def test_groups_of_tags_get_their_own_curves():
    groups = {"first": (1, 2), "second": (3, 7)}
    c = calib.fit(grouped(ranges(30_000), groups), groups=groups).calibration
    grid = np.linspace(*c.bias_curve.range, 200)
    for name, sign in (("first", 1), ("second", -1)):
        assert np.std(c.groups[name].bias_curve(grid) - (sign * bias_m(grid))) < 0.006, name
        assert c.groups[name].bias_curve(np.array([1.0]))[0] == pytest.approx(0, abs=1e-9)

    # A range between the groups has the mean of both curves, which is zero here.
    r = grouped(ranges(3000, seed=8), groups)
    applied, mixed = c.apply(r), np.isin(r.initiator, (1, 2)) != np.isin(r.target, (1, 2))
    assert abs(np.median(applied.corrected_m - r.truth_m)) < 0.02
    assert np.std((applied.delay_corrected_m - applied.corrected_m)[mixed]) < 0.006


@pytest.mark.parametrize("settings", [{}, {"fixed_ns": {1: -0.3}}, {"constants": "pair"}])
def test_a_reference_power_moves_a_constant_and_corrects_ranges_alike(settings):
    r = ranges(600)
    if settings.get("fixed_ns"):
        # For a single pair, the other delay compensates the constant.
        r = r[(r.initiator == 1) & (r.target == 2)]
    plain, stated = (
        calib.fit(r, sequential=True, reference_power_dbm=dbm, **settings).calibration for dbm in (None, -84.0)
    )
    assert stated.bias_curve(np.array([10**-0.2]))[0] == pytest.approx(0, abs=1e-9)
    assert plain.bias_curve(np.array([10**-0.2]))[0] != pytest.approx(0, abs=1e-3)
    np.testing.assert_allclose(stated.apply(r).corrected_m, plain.apply(r).corrected_m, atol=1e-6)


def test_the_band_contains_the_curve():
    inside = []
    for c in (calib.fit(ranges(4000, seed=seed)).calibration for seed in range(3)):
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
    moving = without_static(replace(r, truth_m=np.where(r.time_ns < 10_000_000_000, 2.0, r.truth_m)))
    # Ranges are 5 ms apart.
    assert (len(moving), moving.excluded) == (4000, {"static": 2000})
    with pytest.raises(calib.UnanswerableError, match="nothing moves"):
        without_static(replace(r, truth_m=np.full(len(r), 2.0)))


def test_power_that_varies_with_distance_causes_a_warning():
    assert not any("confounded" in warning for warning in calib.fit(ranges(5000)).warnings)
    # Lifted power decreases linearly with distance: a curve over power may be an error by distance.
    r = ranges(5000, bias=lambda lifted: 0.1 * lifted)
    noise = np.random.default_rng(1).normal(size=(2, len(r))) * 0.01
    fpp1, fpp2 = -82 + 10 * np.log10(3.0 - 0.45 * r.truth_m + noise)
    found = calib.fit(replace(r, fpp1_dbm=fpp1, fpp2_dbm=fpp2))
    assert any("confounded" in warning for warning in found.warnings)
    assert found.calibration.provenance["warnings"] == found.warnings


def test_a_search_that_excludes_a_pair_is_rejected(monkeypatch):
    found_by, r = known_distances.fit_likelihood, ranges(2000)

    def lost(model, *words):
        found = found_by(model, *words)
        # 75 cm in all ranges of a tag: farther from the robust start than reflections shift a median.
        return replace(found, residuals=found.residuals + 0.75 * (model.ranges.initiator == 1))

    assert calib.fit(r).calibration.loss == "mixture"
    monkeypatch.setattr(known_distances, "fit_likelihood", lost)
    assert calib.fit(r).calibration.loss == "cauchy"
    assert "treated all ranges of a pair as reflected" in "".join(calib.fit(r, loss="mixture").warnings)
