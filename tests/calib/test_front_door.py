"""The front door of calib: its names, the cost of importing it, and its examples."""

import doctest
from contextlib import suppress
from dataclasses import replace
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import calib
import uwbsim
from benchmarks.directions import Recipe, flight
from calib.calibration.power_curves import Curve
from calib.estimator.losses import LOSSES
from calib.figures import binned, cumulative, curve_over_power, delays, histogram, within_fence
from calib.report.sections import SECTIONS
from tests import pages
from tests.calib.synthetic import bias_m, ranges
from uwblink.pages import figures


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in dir(calib) if not name.endswith("Error")])
def test_the_examples_run(name, monkeypatch):
    monkeypatch.setattr(figures, "drawn", pages.outline)
    losses, sections = set(LOSSES), dict(SECTIONS)
    runner = doctest.DocTestRunner()
    examples = [test for test in doctest.DocTestFinder().find(getattr(calib, name), name, globs={}) if test.examples]
    assert examples, f"{name} has no example"
    for one in examples:
        runner.run(one)
    assert runner.summarize(verbose=False).failed == 0
    # An example that registers something removes it again, so that other tests do not find it.
    assert (set(LOSSES), dict(SECTIONS)) == (losses, sections)


def test_public_results_print_on_a_screen():
    flight, ranges = calib.sample_flight(300), calib.load_ranges(calib.sample_flight(300))
    known = calib.fit(flight).calibration
    columns = known.correct(ranges.raw_m, ranges.fpp1_dbm, ranges.fpp2_dbm, ranges.initiator, ranges.target)
    for thing in (ranges, known.apply(ranges), columns, known, *calib.localize(flight, known)):
        assert len(repr(thing)) < 2000, type(thing)
        assert max(map(len, repr(thing).splitlines())) <= 120, type(thing)


@pytest.mark.parametrize("wrong", [None, 3, {}], ids=str)
@pytest.mark.parametrize(
    ("call", "parameter"),
    [
        (lambda wrong, _: calib.evaluate(calib.sample_flight(), wrong), "calibration"),
        (lambda wrong, _: calib.localize(calib.sample_flight(), wrong), "calibration"),
        (lambda wrong, _: calib.export(wrong, "csv"), "calibration"),
        (lambda wrong, _: calib.compare(calib.fit(calib.sample_flight(300)), wrong), "second"),
        (lambda wrong, folder: calib.apply(folder / "f.uwb", wrong, folder / "g.uwb"), "calibration"),
        (lambda wrong, folder: calib.write_report(folder / "r.html", calib.sample_flight(), wrong), "calibration"),
    ],
    ids=["evaluate", "localize", "export", "compare", "apply", "write_report"],
)
def test_other_objects_than_calibrations_are_refused(tmp_path, call, parameter, wrong):
    with pytest.raises(calib.BadInputError, match=f"^`{parameter}`.*expected a Calibration"):
        call(wrong, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_results_and_paths_are_accepted_like_calibrations(tmp_path):
    flight = calib.sample_flight()
    result = calib.fit(flight)
    result.save(tmp_path / "c.json")
    with pytest.raises(FileExistsError):
        result.save(tmp_path / "c.json")
    result.save(tmp_path / "c.json", force=True)
    for given in (result, tmp_path / "c.json", str(tmp_path / "c.json")):
        assert calib.evaluate(flight, given).to_dict() == calib.evaluate(flight, result.calibration).to_dict()
        assert calib.compare(given, result).same
        assert calib.export(given, "csv") == calib.export(result.calibration, "csv")
    assert result.correct(3.0, -85.0, -86.0, 1, 2) == result.calibration.correct(3.0, -85.0, -86.0, 1, 2)


# Figures of a calibration: the centre that a curve follows, and axes that an outlier does not flatten.


@pytest.fixture(scope="module")
def fitted():
    return calib.fit(ranges(12_000, tail=0.2))


def axes_of(draw):
    with figures.style():
        axes = draw(Figure(figsize=(7.16, 3), layout="constrained").subplots())
        axes.figure.draw_without_rendering()
    return axes


def labelled(axes, text):
    return next(line for line in axes.lines if line.get_label() == text)


def points_and_curve(axes):
    """Return the drawn points, and the drawn curve at their powers."""
    points, curve = labelled(axes, "core of all pairs"), labelled(axes, "fitted")
    return points, np.interp(points.get_xdata(), curve.get_xdata(), curve.get_ydata())


def test_points_are_the_core_and_medians_lie_above():
    # Planted: a core of 5 cm about zero, a fifth of it lengthened by 40 cm on average.
    rng = np.random.default_rng(5)
    error = rng.normal(0, 0.05, 40_000) + np.where(rng.random(40_000) < 0.2, rng.exponential(0.4, 40_000), 0)
    everything = {"": (np.arange(40_000), 20)}
    found = binned(rng.uniform(0, 1.5, 40_000), error, everything, "mixture")[""]
    # 2000 ranges in a bin determine the centre to 1.5 mm, and the spread, estimated with the tail, to 2 mm.
    assert np.abs(found.centre_m).max() < 0.006
    assert np.abs(found.centre_m.mean()) < 0.001
    assert found.std_m == pytest.approx(0.05, abs=0.008)
    assert found.median_m.mean() == pytest.approx(0.0145, abs=0.003)
    squares = binned(np.arange(40_000.0), error, everything, "l2")[""]
    assert squares.centre_m.mean() == pytest.approx(error.mean(), abs=1e-9)
    assert np.mean(squares.std_m**2) == pytest.approx(error.var(), rel=0.001)


def test_the_drawn_curve_goes_through_the_drawn_points(fitted):
    axes = axes_of(fitted.plot_bias)
    points, at = points_and_curve(axes)
    # 600 per bin: the centre of a core of 5 cm with a fifth of reflections is known to 3 mm; medians are 1.5 cm above.
    assert np.abs(points.get_ydata() - at).max() < 1.2
    assert np.sqrt(np.mean((points.get_ydata() - at) ** 2)) < 0.5
    assert np.mean(labelled(axes, "medians, reflections included").get_ydata() - at) > 1.0
    away = points.get_ydata() - (100 * bias_m(points.get_xdata()))
    assert np.abs(away - away.mean()).max() < 1.2, "and both follow what was planted"
    (top,) = axes.child_axes  # first-path powers in dBm
    dbm = np.array([float(text.get_text().replace("−", "-")) for text in top.get_xticklabels()])
    assert 10 ** ((dbm + 82) / 10) == pytest.approx(top.get_xticks())


def test_curves_with_few_points_are_drawn_completely_or_where_the_ranges_are(fitted):
    power, known = fitted.ranges.fpp1_dbm, fitted.calibration

    def drawn(quantile, known):
        faint = fitted.ranges[power < np.quantile(power, quantile)]
        return faint, axes_of(lambda a: curve_over_power(faint, known.apply(faint), known, "bias", a))

    _, axes = drawn(0.5, known)
    (low, high), curve = axes.get_ylim(), labelled(axes, "fitted").get_ydata()
    assert low < curve.min() < curve.max() < high
    # Far outside of its points it would flatten the figure.
    steep = Curve((0.0,) * 4 + (0.5, 1.0) + (15.0,) * 4, (-0.2, -0.18, 0.04, 0.04, 0.04, 0.04), 3, (0.0, 15.0))
    faint, axes = drawn(0.3, replace(known, bias_curve=steep, uncertainty=None))
    (low, high), of_ranges = axes.get_ylim(), 100 * steep(known.lifted(faint))
    assert np.mean((of_ranges > low) & (of_ranges < high)) > 0.9


def test_the_sigma_curve_goes_through_its_points(fitted):
    points, at = points_and_curve(axes_of(fitted.plot_sigma))
    assert np.mean(points.get_ydata() / at) == pytest.approx(1, abs=0.06)


def test_outlying_delays_do_not_flatten_the_figure(fitted):
    known = fitted.calibration
    std_ns = {**known.delays_std_ns, 9: 300.0, 1: 40.0}
    wild = replace(known, delays_ns={**known.delays_ns, 9: 1000.0}, delays_std_ns=std_ns)
    axes = axes_of(lambda a: delays(wild, axes=a))
    assert np.ptp(axes.get_ylim()) < 3
    assert "+1000.0 ns" in [text.get_text() for text in axes.texts]
    # Of two nobody knows which is the stray.
    fenced = [within_fence(np.array(values)).tolist() for values in ([0.1, 0.2, 0.15, 1000.0], [0.1, 1000.0])]
    assert fenced == [[True, True, True, False], [True, True]]


@pytest.mark.parametrize("offset_m", [0.0, 300.0])
def test_a_histogram_shows_corrected_errors_whatever_raw_ones_are(fitted, offset_m):
    applied = fitted.calibration.apply(fitted.ranges)
    applied = replace(applied, raw_m=applied.raw_m + offset_m)
    axes = axes_of(lambda a: histogram(fitted.ranges, applied, a))
    assert np.ptp(axes.get_xlim()) < 400
    heights = {one.get_label(): sum(one.get_data().values) for one in axes.patches}
    # The outermost bins include larger errors.
    assert [heights[name] for name in ("raw", "fully corrected")] == pytest.approx([100, 100])


def test_the_distribution_shows_shares_of_smaller_errors(fitted):
    applied = fitted.calibration.apply(fitted.ranges)
    line = labelled(axes_of(lambda a: cumulative(fitted.ranges, applied, a)), "fully corrected")
    size, (x, y) = 100 * np.abs(applied.corrected_m - fitted.ranges.truth_m), line.get_data()
    assert 100 * np.mean(size[:, None] <= x, axis=0) == pytest.approx(y, abs=0.1)


def test_undetermined_delays_are_drawn_as_circles(fitted):
    known, name = fitted.calibration, "without an interval: pinned or undetermined"
    open_one = replace(known, delays_std_ns=known.delays_std_ns | {1: np.inf})
    open_axes, axes = (axes_of(lambda axes, one=one: delays(one, axes=axes)) for one in (open_one, known))
    assert labelled(open_axes, name).get_ydata() == pytest.approx([known.delays_ns[1]])
    (bars,) = open_axes.containers
    assert len(bars.lines[0].get_ydata()) == len(known.delays_ns) - 1
    assert name not in axes.get_legend_handles_labels()[1]


def test_planted_delays_are_drawn_moved_by_the_common_shift(fitted):
    axes = axes_of(lambda axes: delays(fitted.calibration, {1: 0.1, 2: -0.2, 3: 0.0, 7: 0.3}, 0.05, axes))
    assert labelled(axes, "planted, same gauge").get_ydata() == pytest.approx([0.15, -0.15, 0.05, 0.35])


# Combinations of settings of a fit, over recordings of different kinds: each gives a calibration or a reason.


FLIGHTS = {
    "three robots": ["icra2023/train"],
    "two flights": ["icra2023/train", "icra2023/test1"],
    "anchors that do not range": ["anchors_and_tag/bipartite"],
    "anchors beside another flight": ["anchors_and_tag/anchors_and_tag", "icra2023/train"],
    "boards that warm up": ["warm_up/warm_up"],
    "without noise": ["noiseless"],
    "patterns": [],
}
SETTINGS: dict[str, tuple[Any, ...]] = {
    "loss": ("mixture", "cauchy", "huber"),
    "lift": ("mean-of-lifted", "lift-of-mean"),
    "constants": ("pair",),
    "use": ("receptions",),
    "pattern": ("none", "shared", "tag"),
    "temperature": ("none", "shared", "tag"),
    "sequential": (True,),
    "delays_only": (True,),
    "scale_ns": (0.001, 10.0),
    "between_m": (0.0, 0.5),
    "reference_power_dbm": (-120.0, -60.0),
    "hold_out": (0.1, 0.9),
    "fixed_ns": ({1: 0.1}, {1: 0.1, 4: 0.0}, dict.fromkeys((1, 2, 3, 4, 5, 6), 0.0)),
    "groups": ({"some": (1, 2, 3)}, {"some": (1, 2), "others": (4, 5)}),
}
CHANGES = [(name, value) for name, values in SETTINGS.items() for value in values]


@cache
def flown(name):
    found = [uwbsim.simulate(uwbsim.load(one, {"run.duration_s": 15.0})) for one in FLIGHTS[name]]
    return found or [flight(Recipe(seconds=20), 1)[0]]


@cache
def another():
    return calib.fit(flown("three robots")).calibration


@pytest.mark.slow
@pytest.mark.parametrize("name", FLIGHTS)
def test_each_setting_alone_and_pairs_of_settings_are_fitted_or_refused(tmp_path, name):
    # A third of all pairs of settings; each flight has its share of them.
    own = list(combinations(CHANGES, 2))[list(FLIGHTS).index(name) :: 3 * len(FLIGHTS)]
    for number, changes in enumerate([*([one] for one in CHANGES), *own]):
        file = tmp_path / f"{number}.json"
        with suppress(calib.CalibError):
            calib.fit(flown(name), **dict(changes)).save(file)
            known = calib.load_calibration(file)
            overall = calib.evaluate(flown(name), known).overall
            assert np.isfinite([*known.delays_ns.values(), overall.full.median_m]).all(), changes
            calib.compare(known, another())
            calib.export(known, "registers")
