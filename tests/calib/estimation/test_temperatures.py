"""Ranges that grow with the temperature of their ends: found, corrected and refused, in flights of NumPy alone."""

import json
import shutil
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import calib
import uwblink
from benchmarks.directions import Recipe, flight
from calib.data.ranges import read_c
from calib.errors import BadInputError, TemperatureWarning, UnanswerableError
from tests.calib import overhearing
from tests.processes import call, run
from uwblink.recording.contents import Contents

WARM = Recipe(pattern_m=0.0, reflected=0.0, noise_m=0.04, warmer_k=15.0, mm_per_k=5.0)
"""Boards warm up by 15 K in a minute, and ranges grow by 5 mm a kelvin of either end: by 15 cm."""


@cache
def flown(recipe, seed, number=0):
    return flight(recipe, seed, number)


@cache
def fitted(recipe, seed, **settings):
    return calib.fit(flown(recipe, seed)[0], between_m=0.0, **settings).calibration


def written(path, recipe, seed, number=0, **more):
    found, _ = flown(recipe, seed, number)
    kept = {"exchanges": found.exchanges, "poses": found.poses, "tags": found.tags, "meta": found.meta}
    Contents(**kept | {"temperature": found.temperature} | more).save(path)
    return path


def rmse(ranges, calibration):
    return float(np.sqrt(np.mean((calibration.apply(ranges).corrected_m - ranges.truth_m) ** 2)))


@pytest.mark.parametrize(("mm_per_k", "apart"), [(2.0, 0.0), (20.0, 0.0), (2.0, 4.0), (20.0, 8.0)])
def test_planted_slopes_are_found_within_their_intervals(mm_per_k, apart):
    recipe = Recipe(pattern_m=0.0, warmer_k=15.0, mm_per_k=mm_per_k, apart_mm_per_k=apart)
    slopes, planted = fitted(recipe, 41).temperatures, flown(recipe, 41)[1]["mm_per_k"]
    assert [one.tags for one in slopes] == ([(1,), (2,), (3,), (4,)] if apart else [(1, 2, 3, 4)])
    for one in slopes:
        # 3600 ranges with 5 cm of noise over 15 K know a common slope to 0.15 mm/K, and each tag's to 0.6.
        assert one.std_m_per_k < (0.0007 if apart else 0.0002)
        assert abs(one.m_per_k - 1e-3 * planted[one.tags[0]]) < 3 * one.std_m_per_k


@pytest.mark.parametrize(
    "recipe",
    [Recipe(pattern_m=0.0, warmer_k=15.0), replace(WARM, mm_per_k=0.0, wall_m=0.05, wander_m=0.03)],
    ids=["plain", "walls and errors that last"],
)
def test_sound_flights_have_no_slope_and_say_how_little_they_show(recipe):
    for seed in (51, 52, 53):
        found = fitted(recipe, seed)
        assert found.temperatures == ()
        assert json.loads(found.to_json())["schema_version"] < 7
        assert "mm/K are no evidence" in repr(found)


def test_a_warmer_flight_is_corrected_by_its_readings(tmp_path):
    first = written(tmp_path / "a.uwb", WARM, 3)
    second = written(tmp_path / "b.uwb", replace(WARM, start_c=45.0, warmer_k=5.0), 3, 1)
    for name, more in (("none", ["--temperature", "none"]), ("auto", [])):
        done = call("calib", "fit", first, "-o", tmp_path / f"{name}.json", "--between", 0, *more)
        assert ("mm/K over temperature" in done.stdout) == (name == "auto")
    without, known = (calib.load_calibration(tmp_path / f"{name}.json") for name in ("none", "auto"))
    there = calib.load_ranges(second)
    with pytest.warns(TemperatureWarning, match=r"^tags 1, 2, 3, 4 were used more than 5 K beyond the 20 to 3\d °C"):
        corrected = known.apply(there)
        assert rmse(there, known) < 0.05
        assert 0.92 < calib.evaluate(second, known).overall.inside_95 < 0.98
    # At 18 K above the fitted mean ranges are 18 cm too long; the slope's standard error leaves 0.5 cm.
    assert rmse(there, without) > 0.15
    done = run("calib", "apply", second, "-c", tmp_path / "auto.json", "-o", tmp_path / "c.uwb")
    assert done.stderr.count("warning: tags 1, 2, 3, 4 were used more than 5 K beyond") == 1
    assert uwblink.load(tmp_path / "c.uwb").exchanges.range_m == pytest.approx(corrected.corrected_m, abs=1e-9)
    assert "mm/K" in call("calib", "show", tmp_path / "auto.json").stdout


def test_a_slope_that_readings_do_not_determine_is_refused_and_said(tmp_path):
    found, _ = flown(WARM, 3)
    flat = found.temperature | {"temperature_c": np.full(len(found.temperature["tag"]), 30.0)}
    for name, readings, why in (("bare", {}, "no temperature is known"), ("flat", flat, "vary too little")):
        path = written(tmp_path / f"{name}.uwb", WARM, 3, temperature=readings)
        done = call("calib", "fit", path, "-o", tmp_path / "x.json", "--temperature", "shared")
        assert (done.returncode, why in done.stderr, done.stderr.count("\n")) == (1, True, 1)
        assert not (tmp_path / "x.json").exists()
        known = calib.fit(path).calibration
        assert known.temperatures == ()
        assert (why in repr(known)) == (name == "flat")
    with pytest.raises(BadInputError, match="sequential"):
        calib.FitSettings(temperature="shared", sequential=True)
    with pytest.raises(BadInputError, match="temperature"):
        calib.fit_from_ranges(found, temperature="shared")
    with pytest.raises(UnanswerableError, match="too few ranges"):
        calib.fit(replace(calib.load_ranges(found)[:300], sessions=()), temperature="tag", pattern="shared")


def test_a_range_is_corrected_by_two_temperatures_and_says_what_is_missing_without():
    known, there = fitted(WARM, 3), calib.load_ranges(flown(WARM, 3, 1)[0])[:500]
    columns = (there.raw_m, there.fpp1_dbm, there.fpp2_dbm, there.initiator, there.target)
    weights = (there.weight_initiator, there.weight_target)
    corrected = known.correct(*columns, weights=weights, temperature_c=tuple(there.temperature_c.T))
    assert corrected.range_m == pytest.approx(known.apply(there).corrected_m, abs=1e-6)
    blind, plain = (one.correct(*columns, weights=weights) for one in (known, replace(known, temperatures=())))
    assert blind.range_m == pytest.approx(plain.range_m, abs=1e-12)
    (slope,) = known.temperatures
    missing = np.sqrt(2) * np.hypot(slope.m_per_k, slope.std_m_per_k) * (slope.span_c[1] - slope.span_c[0])
    assert blind.sigma_total_m == pytest.approx(np.hypot(plain.sigma_total_m, missing), rel=1e-6)
    one, other = (known.correct(3.0, -85.0, -86.0, 1, 2, temperature_c=(25.0, c)).range_m for c in (25.0, 26.0))
    assert one - other == pytest.approx(slope.m_per_k, abs=1e-6)


def test_the_file_keeps_slopes_and_older_programs_refuse_it(tmp_path):
    known = fitted(WARM, 3)
    text = known.to_json()
    assert calib.Calibration.from_json(text) == known
    assert json.loads(text)["schema_version"] == 7
    with pytest.raises(BadInputError, match=r"here: temperatures.*span_c"):
        calib.Calibration.from_json(text.replace('"span_c": [', '"span_c": [-500, '), "here")
    for form in ("miluv", "ros-yaml"):
        with pytest.raises(BadInputError, match="slopes over temperature"):
            calib.export(known, form)
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    calib.export(known, "c-header", tmp_path / "calibration.h")
    calls = 'printf("%.17g %g %g\\n", uwb_warmth(3, 40.0), uwb_warmth(3, NAN), uwb_warmth(9, 40.0))'
    unused = "(void)uwb_correct(1, 0, 0, 1, 2, &x, 0); (void)uwb_errors(0, 0, 1, 2, &x, &x, &x);"
    main = f'#include <stdio.h>\n#include "calibration.h"\nint main(void) {{ double x; {unused} {calls}; return 0; }}\n'
    (tmp_path / "main.c").write_text(main)
    strict = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic")
    subprocess.run([compiler, *strict, "main.c", "-o", "main", "-lm"], cwd=tmp_path, check=True)
    found = subprocess.run(["./main"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()
    (slope,) = known.temperatures
    assert list(map(float, found)) == pytest.approx([slope.m_per_k * (40 - slope.reference_c), 0, 0], abs=1e-12)


def test_temperatures_lie_between_readings_and_end_half_a_minute_after_the_last():
    table = {
        "time_ns": np.array([20, 0, 0, 10]),
        "tag": np.array([1, 1, 2, 1]),
        "temperature_c": [30.0, 20, 50, np.nan],
    }
    table = {name: np.asarray(column) for name, column in table.items()}
    table["time_ns"] = table["time_ns"] * 10**9
    at = np.array([-31, -29, 5, 49, 51]) * 10**9
    found = read_c(table, np.tile([1, 3], (5, 1)), at)
    assert found[:, 0] == pytest.approx([np.nan, 20, 22.5, 30, np.nan], nan_ok=True)
    assert np.isnan(found[:, 1]).all()


def test_differences_of_arrival_are_corrected_for_the_temperature_of_their_target():
    found, _ = overhearing.flight(5, noise_ns=0.0)
    known = calib.fit(found, use="receptions").calibration
    slope = calib.calibration.patterns.TemperatureSlope((0, 1, 2, 3, 4, 5), 0.004, 0.0, 20.0, (10.0, 40.0))
    e = found.exchanges
    tags = np.unique(e.initiator)
    readings = {"time_ns": np.zeros(6, np.int64), "tag": tags, "temperature_c": 20.0 + tags, "supply_v": tags * np.nan}
    warm = calib.load_ranges(replace(found, temperature=readings), use="receptions")
    # A tag that is x longer in a range has a delay that is shorter by 2 x over the speed of light.
    moved = {tag: known.delays_ns[tag] - 0.008 * tag / 0.299702547 for tag in known.delays_ns}
    by_slope = replace(known, temperatures=(slope,)).correct_arrivals(warm[: len(warm) // 8]).corrected_m
    by_delays = replace(known, delays_ns=moved).correct_arrivals(warm[: len(warm) // 8]).corrected_m
    assert by_slope == pytest.approx(by_delays, abs=1e-6)
