"""Ranges that grow with the temperature of their ends: found, corrected and refused, in flights of NumPy alone."""

import json
import re
import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pandas
import pytest

import calib
import uwblink
from benchmarks.directions import Recipe, flight
from calib.calibration import patterns
from calib.data.ranges import read_c
from tests.calib import overhearing
from tests.processes import refuse, run
from tests.uwblink.importers.test_table_forms import as_messages, flights, wrapped, write
from uwblink.importers.guess import guess_map

WARM = Recipe(pattern_m=0.0, reflected=0.0, noise_m=0.04, warmer_k=15.0, mm_per_k=5.0)
"""Boards warm up by 15 K in a minute, and ranges grow by 5 mm per kelvin of either end: by 15 cm."""


flown = cache(flight)


@cache
def fitted(recipe, seed, **settings):
    return calib.fit(flown(recipe, seed)[0], between_m=0.0, **settings).calibration


def written(path, recipe, seed, number=0, **more):
    replace(flown(recipe, seed, number)[0], **more).save(path)
    return path


@pytest.mark.parametrize(
    ("mm_per_k", "apart", "pattern_m"),
    [
        (2, 0, 0),
        (2, 4, 0),
        *(pytest.param(*one, marks=pytest.mark.slow) for one in ((20, 0, 0), (20, 8, 0), (2, 0, 0.1))),
    ],
)
def test_planted_slopes_are_found_within_their_intervals(mm_per_k, apart, pattern_m):
    recipe = Recipe(pattern_m=pattern_m, warmer_k=15.0, mm_per_k=mm_per_k, apart_mm_per_k=apart)
    slopes, planted = fitted(recipe, 41).temperatures, flown(recipe, 41)[1]["mm_per_k"]
    assert [one.tags for one in slopes] == ([(1,), (2,), (3,), (4,)] if apart else [(1, 2, 3, 4)])
    for one in slopes:
        # 3600 ranges with 5 cm of noise over 15 K determine a common slope to 0.15 mm/K, and that of each tag to 0.6.
        most = 0.0007 if apart else 0.0002
        assert abs(one.m_per_k - 1e-3 * planted[one.tags[0]]) / 3 < one.std_m_per_k < most


@pytest.mark.parametrize(
    "recipe",
    [Recipe(pattern_m=0.0, warmer_k=15.0), Recipe(pattern_m=0.0, warmer_k=2.0, wander_m=0.03)],
    ids=["plain", "little warmth, errors that last"],
)
@pytest.mark.parametrize("seed", [306, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (315, 316))])
def test_sound_flights_have_no_slope_and_state_its_uncertainty(recipe, seed):
    found = fitted(recipe, seed)
    assert (found.temperatures, json.loads(found.to_json())["schema_version"] < 7) == ((), True)
    assert "mm/K is not significant" in repr(found)


@pytest.mark.slow
def test_a_warmer_flight_is_corrected_by_its_readings(tmp_path):
    first = written(tmp_path / "a.uwb", WARM, 3)
    second = written(tmp_path / "b.uwb", replace(WARM, start_c=45.0, warmer_k=5.0), 3, 1)
    for name, more in (("none", ["--temperature", "none"]), ("auto", [])):
        done = run("calib", "fit", first, "-o", tmp_path / f"{name}.json", "--between", 0, *more)
        assert ("mm/K over temperature" in done.stdout) == (name == "auto")
    without, known = (calib.load_calibration(tmp_path / f"{name}.json") for name in ("none", "auto"))
    with pytest.warns(
        calib.errors.TemperatureWarning, match=r"^tags 1, 2, 3, 4 were used more than 5 K outside the 20 to 3\d °C"
    ):
        judged = calib.evaluate(second, known).overall
    assert 0.92 < judged.inside_95 < 0.98
    # At 18 K above the fitted mean, ranges are 18 cm too long; the standard error of the slope leaves 0.5 cm.
    assert judged.full.abs95_m < 0.1 < 0.2 < calib.evaluate(second, without).overall.full.abs95_m
    said = run("calib", "apply", second, "-c", tmp_path / "auto.json", "-o", tmp_path / "c.uwb").stderr
    assert said.count("warning: tags 1, 2, 3, 4 were used more than 5 K outside") == 1
    corrected = uwblink.load(tmp_path / "c.uwb").exchanges.range_m - calib.load_ranges(second).truth_m
    assert np.std(corrected) == pytest.approx(judged.full.std_m, abs=1e-9)
    assert "mm/K" in run("calib", "show", tmp_path / "auto.json").stdout


@pytest.mark.parametrize(("celsius", "why"), [(None, "no temperatures are known"), (30.0, "vary too little")])
def test_a_slope_that_readings_do_not_determine_is_refused_and_said(tmp_path, celsius, why):
    read = flown(WARM, 3)[0].temperature
    flat = {**read, "temperature_c": np.full(len(read["tag"]), celsius)} if celsius else {}
    path = written(tmp_path / "a.uwb", WARM, 3, temperature=flat)
    refuse("calib", "fit", path, "-o", tmp_path / "x.json", "--temperature", "shared", status=1, naming=[why])
    known = calib.fit(path).calibration
    assert ((tmp_path / "x.json").exists(), known.temperatures, why in repr(known)) == (False, (), bool(celsius))


def test_a_range_is_corrected_by_two_temperatures_and_says_what_is_missing_without():
    known, there = fitted(WARM, 3), calib.load_ranges(flown(WARM, 3, 1)[0])[:500]
    columns = (there.raw_m, there.fpp1_dbm, there.fpp2_dbm, there.initiator, there.target)
    weights, (slope,) = (there.weight_initiator, there.weight_target), known.temperatures
    corrected = known.correct(*columns, weights=weights, temperature_c=tuple(there.temperature_c.T))
    assert corrected.range_m == pytest.approx(known.apply(there).corrected_m, abs=1e-6)
    blind, plain = (one.correct(*columns, weights=weights) for one in (known, replace(known, temperatures=())))
    assert blind.range_m == pytest.approx(plain.range_m, abs=1e-12)
    # Both ends have any temperature of the fitted span.
    low, high = slope.span_c
    ends = low + (high - low) * (np.arange(2000) + 0.5) / 2000 - slope.reference_c
    missing = np.hypot(slope.m_per_k, slope.std_m_per_k) * np.sqrt(2 * np.mean(ends**2))
    assert blind.sigma_total_m == pytest.approx(np.hypot(plain.sigma_total_m, missing), rel=1e-4)
    one, other = (known.correct(3.0, -85.0, -86.0, 1, 2, temperature_c=(25.0, c)).range_m for c in (25.0, 26.0))
    assert one - other == pytest.approx(slope.m_per_k, abs=1e-6)


def test_temperatures_that_are_no_degrees_of_both_ends_are_refused():
    for celsius, said in (
        (25.0, "1, expected those of initiator"),
        ((300.0, 25.0), "300, expected degrees"),
    ):
        with pytest.raises(calib.BadInputError, match=f"`temperature_c`: found {said}"):
            fitted(WARM, 3).correct(3.0, -85.0, -86.0, 1, 2, temperature_c=celsius)


def test_delays_are_compared_at_one_temperature_or_not_at_all():
    known, hotter = fitted(WARM, 3), fitted(replace(WARM, start_c=35.0), 3, temperature="shared")
    assert hotter.temperatures[0].reference_c - known.temperatures[0].reference_c > 12
    assert calib.compare(known, hotter).same
    # As stated, delays differ by 12 K of 5 mm/K, 0.4 ns; the curves do not.
    blind = [replace(one, temperatures=()) for one in (known, hotter)]
    assert abs(calib.compare(*blind).offset_m) > abs(calib.compare(known, hotter).offset_m) + 0.1
    with pytest.raises(
        calib.UnanswerableError, match=r"tags 1, 2.* slope over temperature in only one of the calibrations"
    ):
        calib.compare(known, blind[1])
    with pytest.raises(calib.BadInputError, match=r"`delays_from`.*reference temperature"):
        calib.fit(flown(WARM, 3, 1)[0], delays_from=known)


def test_an_added_tag_shares_the_slope_of_the_others():
    whole, (hot, _) = fitted(WARM, 3), flown(replace(WARM, start_c=35.0), 3)
    others = {tag: delay for tag, delay in whole.delays_ns.items() if tag != 1}
    (slope,) = whole.temperatures
    known = replace(whole, delays_ns=others, temperatures=(replace(slope, tags=(2, 3, 4)),))
    with pytest.warns(calib.errors.TemperatureWarning):
        added = calib.add_tag(hot, known, 1).calibration
    assert added.temperatures == (replace(slope, tags=(2, 3, 4, 1)),)
    # At 35 to 50 degrees, 15 K above the reference: without the slope, the delay would be 0.5 ns shorter.
    assert added.delays_ns[1] == pytest.approx(whole.delays_ns[1], abs=0.06)


def test_temperatures_lie_between_readings_and_end_half_a_minute_after_the_last():
    table = {"time_ns": np.array([20, 0, 0, 10]) * 10**9, "tag": np.array([1, 1, 2, 1])}
    found = read_c(
        table | {"temperature_c": np.array([30.0, 20, 50, np.nan])},
        np.tile([1, 3], (5, 1)),
        np.array([-31, -29, 5, 49, 51]) * 10**9,
    )
    assert found[:, 0] == pytest.approx([np.nan, 20, 22.5, 30, np.nan], nan_ok=True)
    assert np.isnan(found[:, 1]).all()


def test_differences_of_arrival_are_corrected_for_the_temperature_of_their_target():
    found, _ = overhearing.flight(5, count=600)
    known, tags = calib.fit(found, use="receptions").calibration, np.arange(6)
    readings = {"time_ns": 0 * tags, "tag": tags, "temperature_c": 20.0 + tags, "supply_v": tags * np.nan}
    warm = calib.load_ranges(replace(found, temperature=readings), use="receptions")
    # A tag that adds x to a range has a delay that is smaller by 2 x over the speed of light.
    moved = {tag: known.delays_ns[tag] - 0.008 * tag / 0.299702547 for tag in known.delays_ns}
    slope = patterns.TemperatureSlope(tuple(tags.tolist()), 0.004, 0.0, 20.0, (10.0, 40.0))
    by_slope, by_delays = replace(known, temperatures=(slope,)), replace(known, delays_ns=moved)
    expected = pytest.approx(by_delays.correct_arrivals(warm).corrected_m, abs=1e-6)
    assert by_slope.correct_arrivals(warm).corrected_m == expected


@pytest.mark.parametrize(
    ("header", "answered"),
    [
        ("time_s,from_id,to_id,range_m,from_temperature_c,to_temperature_c", None),
        ("t,tag,anchor,range,tag_temp,anchor_temp", None),
        ("Zeit,Von,Nach,Entfernung,Temperatur von [°C],Temperatur nach [°C]", None),
        ("time,initiator,responder,dist,t_celsius_i,t_celsius_r", None),
        ("time_s,from_id,to_id,range_m,inside,to_temperature_c", '[columns]\nfrom_temperature_c = "inside"\n'),
    ],
)
def test_temperatures_come_from_columns_of_a_table(tmp_path, header, answered):
    rows = [f"{k}.25,1,2,{3 + 0.01 * k},{20 + k},{'' if k == 5 else 40}" for k in range(60)]
    table = tmp_path / "t.csv"
    table.write_text("\n".join([header, *rows]))
    (tmp_path / "m.toml").write_text(answered or guess_map(table).text)
    run("uwblink", "import", "csv", table, "--map", tmp_path / "m.toml", "-o", tmp_path / "t.uwb")
    read = uwblink.load(tmp_path / "t.uwb").temperature
    expected = [(k, 1, 20.0 + k) for k in range(60)] + [(k, 2, 40.0) for k in range(60) if k != 5]
    assert sorted(zip(read["time_ns"] // 10**9, read["tag"], read["temperature_c"], strict=True)) == sorted(expected)


@pytest.mark.parametrize(("cell", "every"), [("hot", 3), ("-127", 3), ("24.5 C", 1), ("298.1", 2)])
def test_cells_that_are_no_temperature_are_named(tmp_path, cell, every):
    rows = [f"{k},1,2,3.{k},{cell if k % every == 0 else 25}" for k in range(60)]
    (tmp_path / "t.csv").write_text("\n".join(["time_s,from_id,to_id,range_m,from_temperature_c", *rows]))
    words, said = (
        ("uwblink", "import", "csv", "t.csv", "-o", "t.uwb"),
        "column 'from_temperature_c' are no plain degrees",
    )
    if every > 2:
        assert f"20 of 60 cells of {said}" in run(*words, cwd=tmp_path).stdout
        assert len(uwblink.load(tmp_path / "t.uwb").temperature["tag"]) == 40
    else:
        refuse(*words, cwd=tmp_path, naming=["t.csv", said, cell])
        assert not (tmp_path / "t.uwb").exists()


def test_temperatures_of_rows_that_are_messages_are_named_as_not_read(tmp_path):
    write(tmp_path / "m.csv", [row | {"from_temperature_c": 25} for row in as_messages(wrapped(flights()))])
    said = run("uwblink", "import", "csv", "m.csv", "-o", "m.uwb", cwd=tmp_path).stdout
    assert "temperatures are only read if a row is an exchange" in said


@pytest.mark.parametrize(
    ("tag", "later_s", "celsius", "said"),
    [
        (99, 0, 25.0, ["memory: no temperatures .* not used"]),
        (1, 3600, 25.0, ["memory: no temperatures .* not used"]),
        (1, 0, 46.0, []),
        (1, 0, 72.0, ["Fahrenheit"]),
    ],
)
def test_readings_of_no_range_and_degrees_fahrenheit_have_a_warning(tag, later_s, celsius, said):
    flight = calib.sample_flight()
    count = len(flight.exchanges)
    readings = {"time_ns": flight.exchanges.time_ns + later_s * 10**9, "tag": np.full(count, tag)}
    readings |= {"temperature_c": np.linspace(celsius - 10, celsius + 10, count), "supply_v": np.full(count, np.nan)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        calib.load_ranges(replace(flight, temperature=readings))
    assert [one.category for one in caught] == [calib.errors.TemperatureWarning] * len(said)
    assert all(re.search(pattern, str(one.message)) for pattern, one in zip(said, caught, strict=True))


def test_exact_ranges_of_a_data_frame_with_hot_boards_fit_and_warn_at_the_line_of_the_caller():
    rng = np.random.default_rng(3)
    away, first = rng.uniform(1, 5, 300), rng.integers(0, 3, 300)
    hot = pandas.DataFrame(
        {
            "t": 0.1 * np.arange(300),
            "initiator": first,
            "target": (first + rng.integers(1, 3, 300)) % 3,
            "range": away + 0.1,
            "true": away,
            "fpp1": rng.uniform(-95, -80, 300),
            "fpp2": rng.uniform(-95, -80, 300),
            "temp": rng.uniform(60, 70, 300),
        }
    )
    with pytest.warns(calib.errors.TemperatureWarning, match="Fahrenheit") as caught:
        found = calib.fit(hot).calibration
    assert {one.filename for one in caught} == {__file__}
    assert found.delays_ns == pytest.approx(dict.fromkeys(range(3), -0.1 / 0.299702547), abs=1e-6)
    assert not found.temperatures
