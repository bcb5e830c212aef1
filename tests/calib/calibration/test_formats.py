"""Calibrations in other formats, and the format of MILUV in both directions."""

import csv
import json
import math
import shutil
import subprocess
import tomllib
from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.calibration import formats, model, patterns
from calib.calibration.error_model import FeatureSlope
from calib.calibration.power_curves import flat_curve
from tests.calib.synthetic import DELAYS_NS, ranges
from tests.shared_data import miluv, shared
from uwblink import importers, ticks
from uwblink.recording.antenna_delays import AntennaDelay
from uwblink.recording.contents import Contents


@pytest.fixture(scope="module")
def fitted():
    return calib.fit(ranges()).calibration


def test_undetermined_delays_are_exported_where_there_is_a_form_for_them(fitted):
    known = replace(fitted, delays_std_ns={**fitted.delays_std_ns, 2: math.inf, 3: math.inf})
    assert "inf" in calib.export(known, "csv").splitlines()[2]
    assert "delay_ns" in calib.export(known, "ros-yaml")


def test_registers_add_to_programmed_delays(tmp_path, fitted):
    known = replace(fitted, delays_ns={1: 0.25, 2: -513.5})
    meta = {
        "configured_antenna_delay_ticks": {"tx": 0, "rx": 0},
        "configured_antenna_delay_ticks_by_tag": {"1": {"tx": 16440, "rx": 16430}},
    }
    Contents(exchanges=calib.sample_flight(10).exchanges, meta=meta).save(tmp_path / "r.uwb")
    base, d = formats.programmed(tmp_path / "r.uwb"), 0.25e-9 / ticks.TICK_S
    found = formats.registers(known, base)
    assert found[1] == (round(16440 - 0.44 * d), round(16430 - 0.56 * d), 16440)
    # A device with registers of zero: both registers together are its whole delay, not 32872 ticks more.
    assert sum(found[2][:2]) == pytest.approx(513.5e-9 / ticks.TICK_S, abs=1)
    with pytest.raises(calib.BadInputError, match="tag 1: its registers would be -7/-9"):
        formats.registers(known, {None: AntennaDelay(0, 0, 0)})
    text = calib.export(known, "registers", base=base)
    assert tomllib.loads(text)["antenna_delays"]["tags"]["1"] == found[1]._asdict()


STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")


def printed(folder, known, main, text=""):
    """Return the output of a program that includes the header of a calibration; skips without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    calib.export(known, "c-header", folder / "calibration.h")
    (folder / "main.c").write_text(main)
    subprocess.run([compiler, *STRICT, "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    return subprocess.run(["./main"], cwd=folder, input=text, capture_output=True, text=True, check=True).stdout


CORRECTING = """
#include <stdio.h>
#include "calibration.h"
int main(void)
{
    double range, one, two, to[2][3], corrected = 0, sigma = 0, total, mean, share, blind = 0, blind_total;
    int initiator, target, k;
    while (scanf("%lf %lf %lf %d %d", &range, &one, &two, &initiator, &target) == 5) {
        int status;
        for (k = 0; k < 6; k++)
            if (scanf("%lf", &to[k / 3][k % 3]) != 1)
                return 1;
        status = uwb_correct(range, one, two, initiator, target, &blind, NULL);
        (void)uwb_errors(one, two, initiator, target, &blind_total, &mean, &share);
        if (status != uwb_correct_toward(range, one, two, initiator, target, to[0], to[1], &corrected, &sigma))
            return 2;
        (void)uwb_errors_toward(one, two, initiator, target, to[0], to[1], &total, &mean, &share);
        printf("%d %.17g %.17g %.17g ", status, corrected, sigma, total);
        printf("%.17g %.17g %.17g %.17g\\n", blind, blind_total, mean, share);
    }
    return 0;
}
"""


def pattern(tags, seed):
    factors, centre, *spread = np.random.default_rng(seed).normal(0, 0.05, (10, 8))
    return patterns.Pattern(
        tags, tuple(factors), tuple(centre), tuple(map(tuple, np.square(spread) @ np.square(spread).T)), 0.05
    )


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"lift": "lift-of-mean"},
        {"power_at": "reception"},
        {"bias_curve": flat_curve(0.03, (0.2, 1.5)), "sigma_curve": flat_curve(0.05, (0.2, 1.5))},
        {"undetermined_splits": (((1, 7), (2, 3)),)},
        {"patterns": (pattern((1, 2), 1), pattern((3,), 2))},
    ],
    ids=lambda change: next(iter(change), "plain"),
)
def test_the_c_header_corrects_as_python_does(tmp_path, fitted, change):
    # A tag that was not fitted: nothing is known of its pairs.
    known = replace(fitted, delays_ns=DELAYS_NS | {50: 0.1}, **change)
    random, tags = np.random.default_rng(8), sorted(known.delays_ns)
    one, two, ends = *tags[:2], np.array([random.choice(tags, 2, replace=False) for _ in range(500)])
    rows = np.column_stack([random.uniform(0, 50, 500), *random.uniform(-110, -70, (2, 500)), ends])
    # Powers that are missing, and a tag that the calibration does not have.
    rows = np.vstack([rows, *[(1.0, *powers, one, two) for powers in ((0, -85), (-85, math.nan), (0, 0))]])
    away = random.normal(size=(len(rows), 2, 3))
    # With the precision of `Ranges`, both sides have equal numbers; every tenth direction is unknown.
    away = (away / np.linalg.norm(away, axis=2, keepdims=True)).astype(np.float32)
    away.reshape(-1, 3)[::10] = math.nan
    table = [*np.hstack([rows, away.reshape(-1, 6)]).tolist(), (1.0, -85.0, -85.0, 9999, one, *range(6))]
    text = "\n".join(f"{r!r} {a!r} {b!r} {i:.0f} {j:.0f} {' '.join(map(str, six))}" for r, a, b, i, j, *six in table)
    *found, strange = (line.split() for line in printed(tmp_path, known, CORRECTING, text).splitlines())
    status, values = np.array(found)[:, 0], np.array(found, dtype=float)[:, 1:]
    ends = rows[:, 3:].astype(int)
    undetermined = np.array([sum(known.sides.get(tag, 0) for tag in pair) != 0 for pair in ends.tolist()])
    assert (strange[0], set(status[undetermined]) <= {"-1"}, len(found)) == ("-1", True, len(rows))
    if undetermined.any():
        with pytest.raises(calib.BadInputError, match="cannot correct"):
            known.correct(*rows[undetermined, :3].T, *ends[undetermined].T)
    some = ~undetermined
    (range_m, fpp1, fpp2), (i, j), kinds = rows[some, :3].T, ends[some].T, status[some]
    blind = known.correct(range_m, fpp1, fpp2, i, j)
    seen = calib.Ranges.from_arrays(range_m, initiator=i, target=j, fpp1_dbm=fpp1, fpp2_dbm=fpp2)
    there = known.apply(replace(seen, toward=away[some]))
    # Without a power, a range is corrected for delays only.
    corrected = np.where(kinds == "2", blind.range_m, there.corrected_m)
    expected = (corrected, blind.sigma_m, there.sigma_total_m, blind.range_m, blind.sigma_total_m)
    np.testing.assert_allclose(values[some].T, [*expected, there.mean_error_m, there.tail_share], rtol=0, atol=1e-12)
    np.testing.assert_array_equal([kinds == "1", kinds == "2"], [blind.clamped, np.isnan(blind.sigma_m)])
    assert len(set(values[:, -1].tolist())) > 100, "shares differ by pair and power"
    assert set(kinds) == ({"0", "1", "2"} if known.needs_power else {"0"})
    changed = np.mean(np.abs(corrected - blind.range_m) > 1e-3)
    assert changed == pytest.approx(0.9 if known.patterns else 0.0, abs=0.15)


WARM = """
#include <stdio.h>
#include "calibration.h"
int main(void)
{
    const double celsius[][2] = {{30.0, 24.5}, {30.0, NAN}, {NAN, NAN}};
    double x, unknown, longer;
    int k;
    (void)uwb_correct(1, 0, 0, 1, 2, &x, 0);
    (void)uwb_errors(0, 0, 1, 2, &x, &x, &x);
    for (k = 0; k < 3; k++) {
        longer = uwb_warmth(1, 3, celsius[k][0], celsius[k][1], &unknown);
        printf("%.17g %.17g ", longer, unknown);
    }
    return 0;
}
"""


SLOPES = (patterns.TemperatureSlope((1, 2, 3, 7), 0.005, 0.0002, 27.5, (20.0, 35.0)),)


def test_the_c_header_states_the_effect_of_temperatures(tmp_path, fitted):
    known, expected = replace(fitted, temperatures=SLOPES), list[float]()
    plain = fitted.correct(3.0, -85.0, -86.0, 1, 3)
    for celsius in ((30.0, 24.5), (30.0, np.nan), (np.nan, np.nan)):
        seen = known.correct(3.0, -85.0, -86.0, 1, 3, temperature_c=celsius)
        expected += [plain.range_m - seen.range_m, seen.sigma_total_m**2 - plain.sigma_total_m**2]
    # Temperatures have single precision: 2e-6 K of 30.
    assert list(map(float, printed(tmp_path, known, WARM).split())) == pytest.approx(expected, abs=1e-8, rel=1e-5)


def test_miluv_is_read_and_given_back_unchanged():
    path = shared("miluv_published_calibration.json")
    found = formats.read_miluv(path)
    assert json.loads(calib.export(found, "miluv")) == json.loads(path.read_text())
    assert found.delays_ns[5] == pytest.approx(-0.7376667)
    assert found.bias_curve(np.array([0.5]))[0] == pytest.approx(0.081, abs=0.002)
    r = replace(ranges(500), initiator=np.full(500, 10), target=np.full(500, 20))
    assert np.isfinite(found.apply(r).corrected_m).all()


@pytest.mark.slow
def test_the_published_calibration_gives_the_published_ranges(tmp_path):
    """Ranges agree within the effect of a fault in the authors' code: it corrects the last stamp with the delay of the
    wrong tag.
    """
    folder, began = miluv(tmp_path), 1_706_822_508_042_560_815
    e = importers.read_source(folder, importer="miluv").exchanges
    rows = [row for path in folder.glob("*/uwb_range.csv") for row in csv.DictReader(path.read_text().splitlines())]
    published = {
        (row["from_id"], row["to_id"], round(float(row["timestamp"]) * 1e9)): float(row["range"]) for row in rows
    }
    ends = zip(
        e.initiator.astype(str).tolist(), e.target.astype(str).tolist(), (e.time_ns - began).tolist(), strict=True
    )
    found = (
        formats.read_miluv(shared("miluv_published_calibration.json")).apply(calib.Ranges.from_exchanges(e)).corrected_m
    )
    off = found - [published[one] for one in ends]
    assert (len(off), np.abs(off).max() < 0.015) == (317, True)
    assert np.sqrt(np.mean(off**2)) < 0.006


SPLINE = '{"knots": [0, 0, 1, 1], "coeffs": [1, 2], "degree": 1}'
MILUV = '{"delays_ns": {"1": 0.1}, "bias_spline_m": %s, "std_spline_m": %s}'


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("0.1", "]"),
        ('{"1": 0.1}', "3"),
        ('{"1"', '{"a"'),
        ("0.1", "NaN"),
        ("0.1", "1e999"),
        ("0.1", "-Infinity"),
        ("0.1", "1" + 400 * "0"),
        ('"1"', '"1.5"'),
        ('"1"', '"' + 5000 * "9" + '"'),
        ("[1, 2]", "[1, NaN]"),
        ("[0, 0, 1, 1]", "[]"),
        ("[0, 0, 1, 1]", "[0, 0, 1, Infinity]"),
        ("0.1", 100_000 * "[" + 100_000 * "]"),
    ],
)
def test_miluv_calibrations_with_infinite_numbers_are_refused(tmp_path, old, new):
    good = MILUV % (SPLINE, SPLINE)
    (tmp_path / "m.json").write_text(good)
    assert formats.read_miluv(tmp_path / "m.json").delays_ns == {1: 0.1}
    (tmp_path / "m.json").write_text(good.replace(old, new))
    with pytest.raises(calib.BadInputError, match=r"m\.json: (not a MILUV calibration|delays_ns)"):
        formats.read_miluv(tmp_path / "m.json")


def test_json_keeps_every_part_and_other_formats_refuse_what_they_have_no_fields_for(fitted):
    """Programs that know no such part refuse the file by its version."""
    curves, open_ns = (fitted.bias_curve, fitted.sigma_curve), dict.fromkeys(DELAYS_NS, math.inf)
    groups = {"a": model.TagGroup((1, 2), *curves), "b": model.TagGroup((3, 7), *curves)}
    for changes, version, forms, said in (
        ({"errors": replace(fitted.errors, features={"rise_taps": FeatureSlope(1.0, 2.0, (1.0, 9.0))})}, 1, (), ""),
        ({"groups": groups}, 2, ("miluv", "ros-yaml", "c-header"), ""),
        ({"pair_offsets": {(1, 2): model.PairOffset(0.1, 0.01)}}, 4, ("csv", "c-header"), "no fields for constants"),
        ({"undetermined_splits": (((1, 7), (2, 3)),), "delays_std_ns": open_ns}, 5, (), ""),
        ({"patterns": (pattern((1, 2), 1),)}, 6, ("miluv", "ros-yaml"), "no fields for patterns over direction"),
        ({"temperatures": SLOPES}, 7, ("miluv", "ros-yaml"), "no fields for slopes over temperature"),
    ):
        known = replace(fitted, **changes)
        for form in forms:
            with pytest.raises(calib.BadInputError, match=f"{said}.*export it as json"):
                calib.export(known, form)
        text = calib.export(known, "json")
        assert (calib.Calibration.from_json(text), json.loads(text)["schema_version"]) == (known, version)
