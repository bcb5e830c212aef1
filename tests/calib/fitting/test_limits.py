"""Fits to incomplete data: each finds the planted values, and states what it cannot determine."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

import calib
import uwblink
from tests.calib.plain_tables import DELAYS_NS, LIGHT, Plan, bias_m, pair_constant_m, rows
from tests.shared_data import ROOT, shared


def ranges(plan, *, power=True):
    table = np.array(list(rows(plan)), dtype=float)
    dbm = table[:, 4] if power else np.full(len(table), math.nan)
    return calib.Ranges.from_arrays(
        table[:, 3], initiator=table[:, 1].astype(int), target=table[:, 2].astype(int), fpp1_dbm=dbm, fpp2_dbm=dbm,
        truth_m=np.linalg.norm(table[:, 5:8] - table[:, 8:], axis=1), time_ns=(table[:, 0] * 1e9).astype(int),
    )  # fmt: skip


def told(result, fragment):
    (found,) = [text for text in result.warnings if fragment in text]
    return found


def near_planted(calibration, *, but=0.0):
    # 500 ranges per tag at 4 cm determine a delay to 12 ps (intervals have their own tests); four of those.
    planted = {tag: DELAYS_NS[tag] + but for tag in calibration.delays_ns}
    assert calibration.delays_ns == pytest.approx(planted, abs=0.05)


def test_delays_alone_need_no_power():
    known = ranges(Plan(), power=False)
    with pytest.raises(calib.UnanswerableError, match="no power; a calibration without a curve needs no power"):
        calib.fit(known)
    result = calib.fit(known, delays_only=True)
    found = result.calibration
    near_planted(found)
    assert (found.bias_curve.flat, found.needs_power) == (True, False)
    assert "the effect of power is unknown" in told(result, "delays only")
    # Its calibration corrects ranges without power, with a sigma.
    one = found.correct(3.0, math.nan, math.nan, 1, 2)
    assert one.range_m == pytest.approx(3.0 + LIGHT * (found.delays_ns[1] + found.delays_ns[2]) / 2)
    assert one.sigma_m == pytest.approx(0.04, rel=0.1)
    assert not one.clamped
    assert np.std(result.residuals_m[result.inliers]) < 0.045


@pytest.mark.parametrize("settings", [{}, {"loss": "cauchy"}, {"sequential": True}])
def test_delays_alone_say_how_much_power_would_have_changed(settings):
    result = calib.fit(ranges(Plan(bias=bias_m)), delays_only=True, **settings)
    said_cm = float(re.search(r"here (\S+) cm", told(result, "delays only"))[1])
    # The change of the curve between the 5 % and 95 % quantiles of power, within the scatter of medians of a bin.
    assert said_cm == pytest.approx(100 * (bias_m(-94.35) - bias_m(-82.65)), abs=1.6)
    near_planted(result.calibration, but=-np.mean([bias_m(p) for p in np.linspace(-95, -82, 200)]) / LIGHT)


def test_a_fit_of_the_curve_alone_includes_the_constant():
    given = {tag: delay + 0.1 for tag, delay in DELAYS_NS.items()}
    result = calib.fit(ranges(Plan(count=6000, bias=bias_m)), fixed_ns=given)
    found, power = result.calibration, np.array([-93.0, -90.0, -88.0, -86.0])
    assert (found.delays_ns, set(found.delays_std_ns.values())) == (given, {0.0})
    wanted = [bias_m(p) + 0.1 * LIGHT for p in power]
    np.testing.assert_allclose(found.bias_curve(10 ** ((power + 82) / 10)), wanted, atol=0.008)
    assert "a common error of the delays is in the curve" in told(result, "curve only")


def test_delays_are_taken_over_from_a_calibration(tmp_path):
    first = calib.fit(ranges(Plan(), power=False), delays_only=True)
    first.save(tmp_path / "first.json")
    again, known = ranges(Plan(seed=2, bias=bias_m)), first.calibration
    from_file = calib.fit(again, delays_from=tmp_path / "first.json").calibration
    assert (from_file.delays_ns, from_file.delays_std_ns) == (known.delays_ns, known.delays_std_ns)
    two = replace(known, delays_ns={1: -0.35, 2: 0.12})
    some = calib.fit(again, delays_from=two, fixed_ns={2: 0.2}).calibration
    assert (some.delays_ns[1], some.delays_ns[2], some.delays_std_ns[2]) == (-0.35, 0.2, 0)
    assert some.delays_std_ns[11] > 0
    for given, only, said in (
        (replace(two, delays_ns={77: 0.0}), False, "its tags are 77"),
        (known, True, "there is nothing to fit"),
    ):
        with pytest.raises(calib.BadInputError, match=said):
            calib.fit(again, delays_from=given, delays_only=only)


def test_an_offset_of_a_pair_is_named_beside_given_delays():
    result = calib.fit(ranges(Plan(bias=bias_m, pair_m={(1, 11): 0.3})), fixed_ns=DELAYS_NS)
    assert re.search("ranges are .* which changes no delay", told(result, "pair 1-11"))


def test_pairs_have_constants_of_their_own_where_delays_cannot_explain_them():
    plan = Plan(count=6000, pair_m={(1, 11): 0.3, (2, 3): -0.1})
    result = calib.fit(ranges(plan), constants="pair", delays_only=True)
    found = result.calibration
    planted = {pair: pair_constant_m(*pair) + plan.pair_m.get(pair, 0.0) for pair in found.pair_offsets}
    # 500 ranges per pair at 4 cm: a standard error of 1.8 mm, which the tail of reflections doubles.
    assert {pair: one.offset_m for pair, one in found.pair_offsets.items()} == pytest.approx(planted, abs=0.012)
    assert all(0.001 < one.std_m < 0.008 for one in found.pair_offsets.values())
    assert len(found.pair_offsets) == 12
    assert "antenna delays are not determined" in told(result, "constants of 12 pairs")
    assert abs(np.median(result.residuals_m)) < 0.005
    with pytest.raises(calib.BadInputError, match="no constant of pair 11-12"):
        found.correct(3.0, -85.0, -85.0, 12, 11)
    assert found.correct(3.0, -85.0, -85.0, 11, 1).range_m == pytest.approx(3 - found.pair_offsets[1, 11].offset_m)


def test_one_power_gives_a_flat_curve_and_a_warning():
    result = calib.fit(ranges(Plan(bias=bias_m, power_dbm=lambda _: -91.0)))
    near_planted(result.calibration, but=-bias_m(-91.0) / LIGHT)
    assert result.calibration.bias_curve.flat
    assert "never changes (-91.0 dBm): the curve is flat" in told(result, "never changes")


@pytest.mark.slow
def test_real_ranges_whose_power_follows_their_distance(tmp_path):
    """Two boards on tripods, 2 to 60 m apart: no delays, a curve known to centimetres, and a constant if requested."""
    table = shared("hanyang_sstwr.csv.gz")
    uwblink.import_recording(table, tmp_path / "h.uwb", map_file=ROOT / "docs" / "maps" / "hanyang.toml")
    known = calib.load_ranges(tmp_path / "h.uwb")
    assert calib.fit(known).calibration.undetermined_splits == (((1,), (12,)),)
    curved = calib.fit(known, constants="pair").calibration
    # Distance explains four fifths of the power: the band is wider than the effect of an error of distances of 1 %.
    assert np.median(np.asarray(curved.band(np.array(curved.bias_curve.range), "bias"), dtype=float)) > 0.01
    result = calib.fit(known, constants="pair", delays_only=True)
    assert "without carrier readings" in told(result, "single-sided")
    ((pair, one),) = result.calibration.pair_offsets.items()
    # The mode of the errors, from a histogram with bins of 5 cm.
    counts, edges = np.histogram(known.raw_m - known.truth_m, np.arange(-1, 3, 0.05))
    assert pair == (1, 12)
    assert one.offset_m == pytest.approx(edges[np.argmax(counts)] + 0.025, abs=0.15)
    # Errors last for minutes here: the uncertainty of detours must not become detours of 15 m.
    applied = result.calibration.apply(known)
    score = (applied.corrected_m - known.truth_m - applied.mean_error_m) / applied.sigma_total_m
    assert 0.7 < float(np.std(score)) < 1.3


def test_skew_of_single_sided_ranges_is_bounded_by_their_reply():
    count, reply = 400, 19_200_000  # ticks of 15.65 ps: 300.5 us
    ids = np.tile([[1, 2], [2, 3], [3, 1]], (count, 1))[:count]
    row = np.arange(count)
    plain = uwblink.Exchanges.from_arrays(
        ids[:, 0], ids[:, 1], tx1=0 * row, rx1=5, tx2=5 + reply, rx2=reply + 1300 + row % 7, time_ns=row * 10**7,
        fpp1_dbm=np.linspace(-95, -82, count), fpp2_dbm=-85.0, truth_m=3.0 + row % 5 * 0.01,
    )  # fmt: skip
    left = calib.load_ranges(plain).uncorrected_skew
    # c/2 x 40 ppm x 300.5 us, by hand.
    expected = 0.5 * 299_702_547 * 40e-6 * 300.5e-6, math.nan
    assert (left.bound_m, left.read_m) == pytest.approx(expected, rel=1e-3, nan_ok=True)
    assert "1.8 m (c/2 x 40 ppm x 300 µs of reply)" in told(calib.fit(plain, delays_only=True), "without carrier")
    read = replace(plain, skew2_ppm=np.full(count, 2.0))
    skew = calib.load_ranges(read).uncorrected_skew
    assert skew.read_m == pytest.approx(0.5 * 299_702_547 * 2e-6 * 300.5e-6, rel=1e-3)
    assert "imported with protocol ss-cfo" in told(calib.fit(read, delays_only=True), "clock skew in them")
    assert calib.load_ranges(replace(read, protocol=np.full(count, "ss-cfo"))).uncorrected_skew is None
