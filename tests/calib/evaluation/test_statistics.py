"""Statistics by pair and overall, compared with their definitions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import interpolate, stats

import calib
from calib.calibration import held_out_line
from calib.data.ranges import Ranges, concatenate
from calib.evaluation import statistics
from calib.figures import errors_by_pair
from tests import processes
from tests.calib.synthetic import DELAYS_NS, bias_m, ranges
from uwblink import SPEED_OF_LIGHT


@pytest.mark.parametrize(("pairs_m", "sessions_m"), [(0.0, 0.0), (0.05, 0.0), (0.05, 0.04)])
def test_errors_are_split_into_within_and_between_pairs_and_sessions(pairs_m, sessions_m):
    rng, (first, second) = np.random.default_rng(7), np.triu_indices(8, 1)
    spread, session = stats.norm.ppf((np.arange(28) + 0.5) / 28), np.arange(16_000) // 4000
    own_m = pairs_m * spread + sessions_m * np.array([rng.permutation(spread) for _ in range(4)])
    pair = rng.integers(0, 28, 16_000)
    error = own_m[session, pair] + rng.normal(0, 0.04, 16_000) + 2.0 * (np.arange(16_000) % 4000 < 200)  # reflections
    some = Ranges.from_arrays(
        3.0 + error, initiator=first[pair], target=second[pair], fpp1_dbm=-85.0, truth_m=3.0,
        time_ns=np.arange(16_000) % 4000 * 10_000_000 + session * 10**15,
    )  # fmt: skip
    found = statistics.split_error(concatenate([some[session == k] for k in range(4)]), error)
    assert found.sessions == 4
    assert found.within_m == pytest.approx(0.04, rel=0.15)
    assert found.between_pairs_m == pytest.approx(pairs_m, abs=0.015)
    assert found.between_sessions_m == pytest.approx(sessions_m, abs=0.008)


def test_evaluations_compare_with_planted_values():
    curve = interpolate.make_interp_spline(np.linspace(-0.5, 2.5, 60), bias_m(np.linspace(-0.5, 2.5, 60)))
    spline = {"knots": curve.t.tolist(), "coefficients": curve.c.tolist(), "degree": 3}
    r = replace(ranges(), planted={"delays_ns": {str(t): d for t, d in DELAYS_NS.items()}, "bias_curve": spline})
    known = calib.fit(r).calibration
    found = statistics.evaluate(r, known).planted
    assert sum(found.delay_error_ns.values()) == pytest.approx(0, abs=1e-12)
    # A shift of the delays and a constant of the curve cancel here.
    shifted = tuple(c + 0.2e-9 * SPEED_OF_LIGHT for c in known.bias_curve.coefficients)
    delays_ns = {tag: delay + 0.2 for tag, delay in known.delays_ns.items()}
    moved = replace(known, delays_ns=delays_ns, bias_curve=replace(known.bias_curve, coefficients=shifted))
    again = statistics.evaluate(r, moved).planted
    assert again.curve_rms_m == pytest.approx(found.curve_rms_m, abs=1e-9)
    assert again.correction_rms_m == pytest.approx(found.correction_rms_m, abs=1e-6)
    # The whole correction, by hand: raw minus truth without noise and tail.
    applied = known.apply(r)
    delays_m = 1e-9 * SPEED_OF_LIGHT * np.array([DELAYS_NS.get(tag, 0.0) for tag in range(8)])
    clean = bias_m(applied.lifted) - r.weight_initiator * delays_m[r.initiator] - r.weight_target * delays_m[r.target]
    wrong = (applied.corrected_m - r.raw_m + clean)[~applied.clamped]
    assert pytest.approx(np.sqrt(np.mean(wrong**2)), rel=0.02) == found.correction_rms_m < 0.005


@pytest.fixture(scope="module")
def found():
    return statistics.evaluate(ranges(2000), calib.fit(ranges(2000)))


def test_an_evaluation_prints_on_a_screen(found):
    lines = repr(found).splitlines()
    assert max(map(len, lines[1:])) <= 80, "a terminal has room for every figure"
    (name, count, *cells), full = lines[-1].split(), found.overall.full
    numbers = [f"{100 * value:.1f}" for value in (full.mean_m, full.median_m, full.robust_std_m)]
    assert (name, count, cells[6:9]) == ("all", "2000", numbers)
    page = found._repr_html_()
    assert (page.count("<tr>"), page.count("data:image/png")) == (3 + 6, 1)


def test_a_figure_has_the_errors_of_each_pair_and_of_many_pairs_the_farthest(found):
    axes = errors_by_pair(7.0, found).axes[0]
    assert [text.get_text() for text in axes.get_xticklabels()] == list(found.pairs)
    for (line, _, (bars,)), stage in zip(axes.containers, ("raw", "full"), strict=True):
        own = [getattr(group, stage) for group in found.pairs.values()]
        np.testing.assert_allclose(line.get_ydata(), [100 * one.median_m for one in own])
        half = [np.ptp(path.vertices[:, 1]) / 2 for path in bars.get_paths()]
        np.testing.assert_allclose(half, [100 * one.robust_std_m for one in own])
    groups = {f"1-{k}": replace(found.overall, raw=replace(found.overall.raw, median_m=k)) for k in range(2, 30)}
    names = [text.get_text() for text in errors_by_pair(7.0, replace(found, pairs=groups)).axes[0].get_xticklabels()]
    assert names == [f"1-{k}" for k in range(6, 30)]


def test_a_new_column_needs_one_row(monkeypatch):
    row = ("full", "95 % |e|", "quantile of absolute errors", lambda group: f"{group.full.abs95_m:.3f}")
    monkeypatch.setattr(statistics, "ERROR_COLUMNS", (*statistics.ERROR_COLUMNS, row))
    flight = calib.load_ranges(calib.sample_flight())
    found = calib.evaluate(flight, calib.fit(flight))
    _, above, head, *rows = repr(found).splitlines()
    assert above.endswith("in     full")
    assert head.endswith("95% 95 % |e|")
    assert rows[-1].endswith(f" {found.overall.full.abs95_m:.3f}")


# A fit evaluated on held-out ranges, which a second fit did not use.


def test_a_part_that_is_held_out_judges_a_fit_to_the_others():
    flight = calib.load_ranges(calib.sample_flight(3000))
    plain = calib.fit(flight).calibration
    found = calib.fit(flight, hold_out=0.3).calibration
    assert found.delays_ns == plain.delays_ns, "what is returned is fitted to all"
    told = found.provenance["held_out"]
    assert told["ranges"] / len(flight) == pytest.approx(0.3, abs=0.05)
    assert abs(told["median_m"]) < 0.01 < abs(told["raw_median_m"])
    assert told["robust_std_m"] == pytest.approx(0.03, rel=0.1)
    assert told["inside_95"] > 0.9
    assert "held_out" not in plain.provenance
    with pytest.raises(calib.BadInputError, match="provenance: held_out"):
        held_out_line(replace(plain, provenance={"held_out": {"ranges": "x"}}))


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"hold_out": 1.0}, calib.BadInputError),
        ({"hold_out": float("nan")}, calib.BadInputError),
        ({"hold_out": 0.3, "fold": "week"}, calib.BadInputError),
        ({"hold_out": 0.3, "fold": "session"}, calib.UnanswerableError),  # it has one session
    ],
)
def test_wrong_settings_of_held_out_ranges_are_refused(changes, error):
    with pytest.raises(error, match=[*changes][-1]):
        calib.fit(calib.sample_flight(), **changes)


# Evaluating a calibration on its fitted recording gives a warning.


@pytest.mark.slow
def test_recordings_are_identified_by_content(tmp_path):
    train, test = calib.sample_flight(), calib.sample_flight(seed=2)
    a, b, c = (tmp_path / folder / "flight.uwb" for folder in "abc")
    for path, flight in ((a, train), (b, test), (c, train)):
        path.parent.mkdir()
        flight.save(path)
    found = calib.fit(a)
    assert [calib.evaluate(data, found).seen for data in (c, b, [train, test])] == [("flight.uwb",), (), ("memory",)]
    found.save(tmp_path / "c.json")
    for path, warned in ((c, "warning: the calibration was fitted to flight.uwb: "), (b, "")):
        done = processes.run("calib", "evaluate", path, "-c", tmp_path / "c.json")
        assert (done.returncode, done.stderr[: len(warned) or None]) == (0, warned)
