"""The calibration file, and the correction of ranges."""

import itertools
import json
import math
from dataclasses import replace

import duckdb
import numpy as np
import pytest
from scipy import interpolate, signal, stats

import calib
from calib.calibration.error_model import ErrorModel, PairErrors
from calib.calibration.model import Calibration, TagGroup, load_calibration
from tests.calib.synthetic import ranges
from tests.processes import refuse, succeed
from uwblink import SPEED_OF_LIGHT, Contents, Exchanges, Recording
from uwblink.recording.schema import TABLES, CirRow, Fault, FrameRow


@pytest.fixture(scope="module")
def fitted():
    return calib.fit(ranges()).calibration


@pytest.mark.parametrize(("changes", "version"), [({}, 1), ({"power_at": "reception"}, 3)])
def test_json_both_ways_without_loss(fitted, tmp_path, changes, version):
    known = replace(fitted, **changes)
    known.save(tmp_path / "c.json")
    again = load_calibration(tmp_path / "c.json")
    assert (again, again.to_json()) == (known, known.to_json())
    assert json.loads(known.to_json())["schema_version"] == version


def powers_at(lift, power_at, dbm):
    """Return the lifted powers at which the bias is evaluated, from those of both ends."""
    lifted, of_mean = (10 ** ((np.array(one) + 82) / 10) for one in (dbm, np.mean(dbm)))
    return lifted if power_at == "reception" else [of_mean if lift == "lift-of-mean" else lifted.mean()]


@pytest.mark.parametrize(
    ("lift", "power_at"),
    [("mean-of-lifted", "exchange"), ("lift-of-mean", "exchange"), ("mean-of-lifted", "reception")],
)
@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize(
    ("printed", "both", "ends"),
    [
        ((-85.0, -92.0), (-85.0, -92.0), (1, 2)),
        ((0.0, -90.0), (-90.0, -90.0), (3, 1)),
        ((-88.0, np.nan), (-88.0, -88.0), (7, 3)),
    ],
)
def test_ranges_are_corrected_by_the_formulas(fitted, lift, power_at, grouped, printed, both, ends):
    """A range is corrected by half of each delay and the mean curve of both tags, at the available powers; one range,
    or arrays.
    """
    curve, sigma = fitted.bias_curve, fitted.sigma_curve
    lower = replace(curve, coefficients=tuple(c - 0.1 for c in curve.coefficients))
    noisy = replace(sigma, coefficients=tuple(2 * c for c in sigma.coefficients))
    own = {"a": TagGroup((1, 2), curve, sigma), "b": TagGroup((3, 7), lower, noisy)}
    known = replace(fitted, lift=lift, power_at=power_at, groups=own if grouped else {})
    (i, j), share = ends, sum(tag > 2 for tag in ends) / 2 if grouped else 0.0
    found = known.correct(3.0, *printed, i, j, weights=(0.5, 0.50001))
    delays = SPEED_OF_LIGHT * 1e-9 * (0.5 * known.delays_ns[i] + 0.50001 * known.delays_ns[j])
    spline, at = interpolate.BSpline(curve.knots, curve.coefficients, 3), powers_at(lift, power_at, both)
    bias = np.mean([spline(np.clip(one, *curve.range)) for one in at]) - 0.1 * share
    assert (found.range_m, type(found.range_m)) == (pytest.approx(3.0 + delays - bias, abs=1e-9), float)
    (middle,) = powers_at(lift, "exchange", both)
    at_both = replace(known, power_at="exchange").correct(3.0, *both, i, j)
    assert found.sigma_m == at_both.sigma_m == pytest.approx((1 + share) * sigma(np.clip(middle, *sigma.range)))
    together = known.correct(np.array([3.0, 4.0]), *printed, i, [j, j], weights=(0.5, 0.50001))
    np.testing.assert_array_equal([column[0] for column in together], found)
    assert together.range_m[1] == pytest.approx(1 + found.range_m)


def test_ranges_without_power_have_no_sigma_and_those_beyond_the_curve_a_larger_one(fitted):
    blind = fitted.correct(3.0, 0.0, np.nan, 1, 2)
    assert blind.range_m == pytest.approx(3.0 + SPEED_OF_LIGHT * 5e-10 * (fitted.delays_ns[1] + fitted.delays_ns[2]))
    assert np.isnan([blind.sigma_m, blind.sigma_total_m, blind.tail_share]).all()
    far, near = (fitted.correct(3.0, dbm, dbm, 1, 2) for dbm in (-60.0, -79.0))
    assert (blind.clamped, far.clamped) == (False, True)
    assert far.sigma_total_m > near.sigma_total_m


def test_the_band_of_a_polygon_is_that_of_its_corners(fitted):
    """Files may have curves of another degree than fitted ones: halfway between corners, half of each counts."""
    low, high = fitted.bias_curve.range
    curve = replace(fitted.bias_curve, knots=(low, low, high, high), coefficients=(0.0, 0.1), degree=1)
    uncertainty = replace(fitted.uncertainty, bias_m2=((4e-4, 0.0), (0.0, 1e-4)))
    known = calib.Calibration.from_json(replace(fitted, bias_curve=curve, uncertainty=uncertainty).to_json())
    band = known.band(np.array([0.0, low, (low + high) / 2, high]), "bias")
    assert band == pytest.approx([0.02, 0.02, np.sqrt(5e-4) / 2, 0.01])


@pytest.mark.parametrize("name", ["1-2", "2-1"])
def test_factors_of_a_pair_hold_in_both_directions(fitted, name):
    errors = replace(fitted.errors, pairs={name: PairErrors(1.0, 3.0, 1.0)})
    known = Calibration.from_json(replace(fitted, errors=errors).to_json())
    share = np.array([known.correct(3.0, -85.0, -86.0, *ends).tail_share for ends in ((1, 2), (2, 1), (1, 3))])
    there, back, other = share / (1 - share)
    assert there == back == pytest.approx(3 * other)


@pytest.mark.parametrize(
    ("use", "error", "said"),
    [
        (
            lambda known: replace(known, groups={"a": TagGroup((1, 2, 3), known.bias_curve, known.sigma_curve)}).apply(
                ranges(10)
            ),
            calib.BadInputError,
            "tag 7 is in none",
        ),
        (
            lambda known: calib.compare(known, replace(known, delays_ns={99: 0.0})),
            calib.UnanswerableError,
            "0 tags have determined delays in both",
        ),
        *(
            (
                lambda known, shares=shares: known.quantiles(ranges(10), shares),
                calib.BadInputError,
                r"`shares`: .*between 0 and 1",
            )
            for shares in ([], [0.0], [1.2], [[0.5]])
        ),
    ],
)
def test_what_a_calibration_cannot_be_used_for_is_named(fitted, use, error, said):
    with pytest.raises(error, match=said):
        use(fitted)


# A corrected recording: the ranges that `evaluate` uses, and all other rows of all tables unchanged.


def full_recording(path):
    """Write a recording with rows in every table, in which a board printed 0.0000 dBm now and then."""
    flight = calib.sample_flight(600)
    # Powers are those of the flight, or zero in every ninth or ninetieth row.
    fpp1_dbm, fpp2_dbm = (
        np.where(np.arange(600) % every == 0, 0.0, column)
        for every, column in ((9, flight.exchanges.fpp1_dbm), (90, flight.exchanges.fpp2_dbm))
    )
    Contents(
        exchanges=replace(flight.exchanges, fpp1_dbm=fpp1_dbm, fpp2_dbm=fpp2_dbm),
        poses=flight.poses, tags=flight.tags, meta={"note": "kept"},
        faults=[Fault(5, "1", "time-out", "no answer")], cirs=[CirRow(9, 1, 1, 2, 741.25, tuple(range(1016)))],
        frames=[FrameRow(7, "1", "in", b"\x00\xff raw"), FrameRow(8, "1", "out", b"C05")],
    ).save(path)  # fmt: skip
    kinds = {"BIGINT": [11], "VARCHAR": ["b1"], "DOUBLE": [0.5], "USMALLINT": [3]}
    with Recording.open(path, update=True) as recording:
        recording.append("overheard", [{name: float(k) for k, name in enumerate(TABLES["overheard"])}])
        # Without "corrected", which is the result.
        names = ("imu", "height", "powers", "quality", "receptions", "differences", "temperature")
        for table in (*names, "arrangements", "distances"):
            recording.append(table, {name: np.array(kinds[kind]) for name, kind in TABLES[table].items()})


def rows(path, table):
    with duckdb.connect(str(path), read_only=True) as db:
        found = db.execute(f"SELECT * FROM {table}")
        return [column[0] for column in found.description], found.fetchall()


@pytest.fixture(scope="module")
def corrected(tmp_path_factory):
    """A folder with the recordings f.uwb and c.uwb, a calibration, and what the correction returned."""
    folder = tmp_path_factory.mktemp("corrected")
    full_recording(folder / "f.uwb")
    known = calib.fit(folder / "f.uwb").calibration
    with pytest.warns(calib.errors.LeftOutWarning, match="^1 differences of arrival without stamps are copied"):
        return folder, known, calib.apply(folder / "f.uwb", known, folder / "c.uwb")


@pytest.mark.parametrize("table", sorted(TABLES.keys() - {"corrected"}))
def test_every_table_is_there(corrected, table):
    (names, before), (also, after) = (rows(corrected[0] / name, table) for name in ("f.uwb", "c.uwb"))
    assert names == also
    assert before, "a table without rows shows nothing"
    if table == "exchanges":
        place = names.index("range_m")
        before, after = ([row[:place] + row[place + 1 :] for row in part] for part in (before, after))
    if table == "meta":
        before, after = sorted(before), sorted(row for row in after if row[0] != "calibration")
    assert repr(after) == repr(before)


def test_a_corrected_recording_is_not_corrected_again(corrected):
    folder, known, _ = corrected
    with pytest.raises(calib.BadInputError, match="already corrected"):
        calib.apply(folder / "c.uwb", known, folder / "again.uwb")
    assert not (folder / "again.uwb").exists()


def test_corrected_ranges_without_stamps_are_not_corrected_again(tmp_path):
    flight = calib.sample_flight(300)
    known, e = calib.fit(flight).calibration, flight.exchanges
    columns = {name: getattr(e, name) for name in ("range_m", "time_ns", "fpp1_dbm", "fpp2_dbm")}
    replace(flight, exchanges=Exchanges.from_arrays(e.initiator, e.target, **columns)).save(tmp_path / "f.uwb")
    known.save(tmp_path / "k.json")
    calib.apply(tmp_path / "f.uwb", known, tmp_path / "c.uwb")
    assert calib.evaluate(tmp_path / "f.uwb", known).overall.full.n == 300
    for words in ("evaluate c.uwb -c k.json", "localize c.uwb -c k.json", "fit c.uwb -o again.json"):
        refuse("calib", *words.split(), cwd=tmp_path, naming=["c.uwb", "already corrected"])
    assert not (tmp_path / "again.json").exists()


def test_a_recording_without_exchanges_is_corrected_to_one_without(fitted, tmp_path):
    flight = calib.sample_flight(600)
    replace(flight, exchanges=flight.exchanges[:0]).save(tmp_path / "f.uwb")
    done = calib.apply(tmp_path / "f.uwb", fitted, tmp_path / "c.uwb")
    assert (done.count, done.clamped) == (0, 0)


def test_ranges_without_power_are_counted_apart(corrected):
    folder, _, done = corrected
    names, table = rows(folder / "c.uwb", "corrected")
    clamped, sigma_m = (np.array([row[names.index(name)] for row in table], float) for name in ("clamped", "sigma_m"))
    assert (done.count, done.clamped, done.unpowered) == (600, np.count_nonzero(clamped), 7)
    assert np.count_nonzero(np.isnan(sigma_m)) == 7


@pytest.mark.filterwarnings("ignore:1 differences of arrival without stamps are copied")
@pytest.mark.parametrize("size", [37, 599])
def test_blocks_of_any_size_are_corrected_alike(corrected, tmp_path, monkeypatch, size):
    folder, known, done = corrected
    blocks = Recording.exchange_blocks
    monkeypatch.setattr(Recording, "exchange_blocks", lambda recording: blocks(recording, size))
    assert calib.apply(folder / "f.uwb", known, tmp_path / "c.uwb") == done
    for table in ("exchanges", "corrected", "poses", "cirs"):
        assert repr(rows(tmp_path / "c.uwb", table)) == repr(rows(folder / "c.uwb", table))


# Parts of errors, against densities by SciPy, and in files; moments and quantiles are in tests/calib/report.


MODEL = ErrorModel(
    lifted=(0.1, 0.5, 1.5),
    noise_m=(0.08, 0.05, 0.03),
    tail_share=(0.3, 0.2, 0.1),
    least_m=0.05,
    detour_m=0.3,
    outlier_share=0.002,
    outlier_m=0.9,
    location_m=0.02,
    pairs={"1-2": PairErrors(1.5, 3.0, 0.5)},
)


def test_errors_far_beyond_all_densities_are_outliers():
    shapes = MODEL.shapes(np.full(3, 0.5), np.full(3, 1), np.full(3, 2))
    tail, (near, _, far) = MODEL.tail_given(np.array([-3.0, 80.0, 1e6]), shapes)
    assert 0.999 < near <= far == 1.0
    assert np.isfinite(tail).all()


def test_probabilities_given_an_error_agree_with_scipy():
    model, error = replace(MODEL, outlier_share=0.05, outlier_m=3.0), np.linspace(-1, 4, 101)
    shapes = model.shapes(np.full(101, 0.5), np.full(101, 3), np.full(101, 7))
    core = 0.95 * 0.8 * stats.norm.pdf(error - 0.02, scale=0.05)
    tail = 0.95 * 0.2 * stats.exponnorm.pdf(error - 0.02, 0.3 / 0.05, loc=0.05, scale=0.05)
    wild = 0.05 * stats.norm.pdf(error - 0.02, scale=3.0)
    expected = np.array([tail, wild]) / (core + tail + wild)
    np.testing.assert_allclose(model.tail_given(error, shapes), expected, atol=1e-9)


def test_error_models_may_be_missing(fitted):
    flight, document = ranges(600, seed=2), json.loads(fitted.to_json())
    del document["errors"]
    old = Calibration.from_json(json.dumps(document))
    applied = old.apply(flight)
    assert np.isnan([applied.sigma_total_m, applied.tail_share]).all()
    assert not applied.outlier.any()
    np.testing.assert_array_equal(applied.corrected_m, fitted.apply(flight).corrected_m)
    judged = calib.evaluate(flight, old)
    assert json.loads(json.dumps(judged.to_dict()))["overall"]["total_std"] is None
    assert "-" in repr(judged)
    with pytest.raises(calib.UnanswerableError, match="has no error model"):
        old.quantiles(flight)


SLOPE = {"tags": [1], "m_per_k": 0.002, "std_m_per_k": 0.0, "reference_c": 25.0, "span_c": [20, 30]}
FEATURE = {"log_odds": 1.0, "centre": 2.0, "bounds": [1.0, 9.0]}
DRIFT = {"sessions": 2, "days": "x", "m2_per_day": [0, 1, 2], "told": 1, "by_age": 1}
PATTERN = {"tags": [1, 2], "coefficients_m": [0.0] * 8, "covariance_m2": [[0.0] * 8] * 8, "rms_m": 0.01}


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("bias_curve/degree", 9, "bias_curve"),
        ("loss", 5, "loss"),
        ("delays_ns/x", 1, "delays_ns"),
        ("alpha_dbm", "low", "alpha_dbm"),
        ("power_at", "somewhere", "power_at"),
        ("speed_of_light", math.nan, ""),
        ("scale_ns", 1e300, "scale_ns"),
        ("uncertainty/tags", [9, 1, 2, 3, 7], "uncertainty"),
        ("provenance/added", "1e400", ""),
        ("provenance/added", -math.inf, ""),
        ("provenance/added", "deep", ""),
        ("provenance/drift", {"m2_per_day": "fast"}, "provenance: drift"),
        ("provenance/drift", {}, "provenance: drift"),
        ("provenance/drift", DRIFT, "provenance: drift"),
        ("temperatures", [SLOPE | {"tags": [9]}], "temperatures"),
        ("temperatures", [SLOPE] * 2, "temperatures"),
        ("temperatures", [SLOPE | {"span_c": [-500, 30]}], "temperatures.*span_c"),
        ("temperatures", [SLOPE | {"span_c": [30, 20]}], "span_c: expected the lowest before the highest"),
        ("patterns", [PATTERN | {"centre": [0.0] * 7}], "patterns.*8"),
        ("undetermined_splits", [[[1, 9], [3, 7]]], "undetermined_splits: expected calibrated tags, each one once"),
        ("errors/features", {"colour": FEATURE}, "features.*rise_taps"),
        ("errors/features", {"rise_taps": FEATURE | {"bounds": [9.0, 1.0]}}, "features: rise_taps: bounds"),
        ("errors/features", {"rise_taps": FEATURE | {"log_odds": 1e9}}, "features: rise_taps: log_odds"),
        ("errors/features", {"rise_taps": FEATURE | {"bounds": 3.0}}, "features: rise_taps: bounds"),
        ("speed_of_light", 0, "speed_of_light"),
        ("speed_of_light", 3e5, "speed_of_light"),
        ("delays_ns/2", 9.2e18, "delays_ns"),
        ("delays_ns/2", 10**400, "delays_ns"),
        ("delays_ns/2", None, "delays_ns"),
        ("delays_ns/" + "9" * 5000, 0.1, "delays_ns"),
        ("delays_std_ns/2", -0.05, "delays_std_ns"),
        ("delays_std_ns/2", 9.2e18, "delays_std_ns"),
        ("scale_ns", -1.0, "scale_ns"),
        ("alpha_dbm", 4000.0, "alpha_dbm"),
        ("bias_curve/coefficients/0", 1e30, "bias_curve"),
        ("sigma_curve/coefficients/0", -0.5, "sigma_curve"),
        ("errors/lifted", [0.1], "errors: lifted"),
        ("errors/noise_m", [0.0] * 8, "errors: noise_m: 0: .*above 0"),
        ("errors/noise_m", [1.0] * 7, "errors: lifted"),
        ("errors/tail_share", [1.5] * 8, "errors: tail_share: 0"),
        ("errors/pairs", {"one-two": {}}, "names of pairs"),
        ("errors/pairs", {"1-2": {"noise": 1.0, "odds": 0.0, "detour": 1.0}}, "1-2: odds"),
        ("errors/levels", [[0.1]], "levels"),
        ("errors/levels/0/0", 2.0, "levels"),
        ("errors/scale", "wide", "scale"),
        ("errors/scale", 0.0, "scale"),
        ("errors/outlier_share", 1.5, "outlier_share"),
        ("errors/outlier_m", -3.0, "outlier_m"),
        ("errors/detour_m", -0.1, "detour_m"),
        ("errors/long_share", 1.5, "long_share"),
        ("uncertainty/delays_ns2/0/0", -0.01, "uncertainty"),
        ("uncertainty/bias_m2", [[1.0]], "uncertainty"),
    ],
)
def test_impossible_values_in_files_are_refused_by_name(fitted, path, value, said):
    table = inner = json.loads(fitted.to_json())
    *outer, last = path.split("/")
    for key in outer:
        inner = inner[int(key) if isinstance(inner, list) else key]
    inner[int(last) if isinstance(inner, list) else last] = value
    text = json.dumps(table).replace('"1e400"', "1e400").replace('"deep"', 300 * "[" + 300 * "]")
    with pytest.raises(calib.BadInputError, match=rf"\Ahere: .*{said}.*\Z"):  # one line
        Calibration.from_json(text, "here")


def test_a_fit_estimates_the_persistence_of_errors():
    """Half of the variance is a Gauss-Markov process of each pair with a correlation time of half a second."""
    flight, keep = calib.load_ranges(calib.sample_flight(9000)), np.exp(-0.03 / 0.5)
    steps = np.random.default_rng(5).normal(0, 0.03 * np.sqrt(1 - keep**2), (3000, 3))
    shared = signal.lfilter([1.0], [1.0, -keep], steps, axis=0).ravel()
    found = calib.fit(replace(flight, raw_m=flight.raw_m + shared)).calibration
    lasting = found.errors.lasting
    assert (lasting.lasting_variance, lasting.own_variance) == pytest.approx((0.5, 0.5), abs=0.1)
    assert (lasting.time_s, lasting.mean) == (pytest.approx(0.5, rel=0.4), pytest.approx(0.0, abs=0.1))

    assert calib.fit(flight).calibration.errors.lasting.lasting_variance < 0.05


@pytest.mark.parametrize("renewal_s", [0.0, 0.3, 1.0])
def test_a_fit_estimates_the_duration_of_reflections(renewal_s):
    """A fifth of the ranges is reflected; ranges of a pair, every third one, are 30 ms apart."""
    flight, rng = calib.load_ranges(calib.sample_flight(9000)), np.random.default_rng(6)
    renewed = rng.random((3000, 3)) > (np.exp(-0.03 / renewal_s) if renewal_s else 0.0)
    drawn = np.where(rng.random((3000, 3)) < 0.2, rng.exponential(0.5, (3000, 3)), 0.0)
    since = np.maximum.accumulate(np.where(renewed, np.arange(3000)[:, None], 0), axis=0)
    detour_m = np.take_along_axis(drawn, since, axis=0).ravel()
    found = calib.fit(replace(flight, raw_m=flight.raw_m + detour_m)).calibration.errors.lasting.renewal_s
    assert found == pytest.approx(renewal_s, rel=0.4, abs=0.03)


# Comparison of two calibrations.


@pytest.mark.slow
def test_fits_of_the_same_tags_differ_in_5_percent_of_comparisons():
    fits = [calib.fit(ranges(3000, seed=seed)).calibration for seed in range(9)]
    found = [calib.compare(a, b) for a, b in itertools.pairwise(fits)]
    # 8 comparisons with 0.4 expected differences; more than three occur by chance in less than one of a thousand cases.
    assert sum(one.same for one in found) >= 5
    # Four delays minus a shift: chi-square with 3 degrees of freedom, whose mean over 8 has a standard error of 0.9.
    # Intervals allow for small samples and for the unknown shape of reflections, so they are slightly wide.
    assert 0.9 < np.mean([one.chi_square for one in found]) < 5.0
    assert 0.55 < np.std([d / one.std_ns[t] for one in found for t, d in one.difference_ns.items()]) < 1.3


def test_a_changed_delay_is_detected(fitted):
    found = calib.compare(fitted, replace(fitted, delays_ns=fitted.delays_ns | {3: fitted.delays_ns[3] + 0.2}))
    assert (found.same, max(found.difference_ns, key=lambda t: abs(found.difference_ns[t]))) == (False, 3)
    assert f"{found.difference_ns[3]:+.4f} ns" in str(found)


def test_a_common_shift_of_delays_and_curve_is_no_difference(fitted):
    moved_ns = {tag: delay + 0.05 / SPEED_OF_LIGHT * 1e9 for tag, delay in fitted.delays_ns.items()}
    curve = replace(fitted.bias_curve, coefficients=tuple(c + 0.05 for c in fitted.bias_curve.coefficients))
    found = calib.compare(fitted, replace(fitted, delays_ns=moved_ns, bias_curve=curve))
    assert found.same
    assert [found.offset_m, found.curve_rms_m, *found.difference_ns.values()] == pytest.approx([0] * 6, abs=1e-9)


@pytest.mark.slow
def test_undetermined_pairs_are_named_and_other_pairs_corrected(tmp_path):
    """Two tags and two anchors; in the second flight the tags also range with each other."""

    def run(words):
        return succeed("calib", *words.split(), cwd=tmp_path)

    flight = calib.sample_flight(180)
    ends = np.sort([flight.exchanges.initiator, flight.exchanges.target], axis=0).T
    across = ends[:, 0] == ends.min()
    for name, kept in (("across.uwb", across), ("all.uwb", across | True), ("within.uwb", ~across)):
        replace(flight, exchanges=flight.exchanges[kept]).save(tmp_path / name)
    run("fit across.uwb -o c.json")
    whole, part = run("apply across.uwb -c c.json -o one.uwb"), run("apply all.uwb -c c.json -o two.uwb")
    named = [f"{a}-{b}" for a, b in np.unique(ends[~across], axis=0)]
    assert "left out" not in whole.stderr
    assert [line for line in part.stderr.splitlines() if all(pair in line for pair in named)]
    assert f"{np.count_nonzero(~across)} ranges are left out" in part.stderr
    for table in ("corrected", "exchanges"):
        assert rows(tmp_path / "two.uwb", table) == rows(tmp_path / "one.uwb", table)
    # Evaluation and localization also leave these pairs out.
    for command in ("evaluate {} -c c.json", "localize {} -c c.json --seeds 1"):
        one, other = (run(command.format(name)) for name in ("across.uwb", "all.uwb"))
        assert one.stdout.replace("across.uwb", "all.uwb").split() == other.stdout.split()
        assert ["left out" in said.stderr for said in (one, other)] == [False, True]
    refuse("calib", "apply", "within.uwb", "-c", "c.json", "-o", "no.uwb", cwd=tmp_path, naming=[named[0], "determine"])
    assert not (tmp_path / "no.uwb").exists()
