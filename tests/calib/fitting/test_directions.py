"""Antennas whose delay depends on direction: found, corrected and refused, in flights of a separate generator."""

import json
import re
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import calib
import uwblink
from benchmarks.directions import Recipe, flight, pattern_m
from calib.report import Picture, results, sections
from tests.processes import refuse, run, succeed
from uwblink.pages.figures import drawn
from uwblink.recording.distances import antennas_m

TEN = Recipe(reflected=0.0, noise_m=0.04)
"""Ranges differ by 10 cm over directions, and none is reflected."""
SHORT = replace(TEN, seconds=30.0)
"""1800 ranges, enough to fit a pattern in tests of something else than its errors."""


@cache
def flown(recipe, seed, number=0):
    return flight(recipe, seed, number)


@cache
def fitted(recipe, seed, **settings):
    return calib.fit(flown(recipe, seed)[0], between_m=0.0, **settings)


def written(path, recipe, seed, number=0):
    flown(recipe, seed, number)[0].save(path)
    return path


def seen(ranges, tag):
    """Return the directions in which a tag saw others (m, 3)."""
    ends = (ranges.initiator, ranges.target)
    return np.concatenate([ranges.toward[np.isin(ids, tag), end] for end, ids in enumerate(ends)]).astype(float)


@pytest.mark.parametrize("size_m", [0.1, *(pytest.param(size, marks=pytest.mark.slow) for size in (0.05, 0.2))])
@pytest.mark.parametrize("own", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_planted_pattern_is_found_within_its_intervals(size_m, own):
    recipe, found = Recipe(pattern_m=size_m, own=own), list[tuple[float, float]]()
    result, waves = fitted(recipe, 11), flown(recipe, 11)[1]["waves"]
    assert [p.tags for p in result.calibration.patterns] == ([(1,), (2,), (3,), (4,)] if own else [(1, 2, 3, 4)])
    everywhere = np.concatenate([seen(result.ranges, tag) for tag in (1, 2, 3, 4)])
    there = calib.load_ranges(flown(recipe, 11, 1)[0])
    for pattern in result.calibration.patterns:
        for tag in pattern.tags:
            toward = seen(there, tag)
            planted = pattern_m(toward, waves[tag], size_m) - pattern_m(everywhere, waves[tag], size_m).mean()
            values = pattern.values(toward)
            off = values @ np.array(pattern.coefficients_m) - planted
            found.append((np.mean(np.abs(off) < 1.96 * pattern.std_m(values)), np.sqrt(np.mean(off**2))))
    inside, error = np.transpose(found)
    assert np.mean(inside) > 0.9
    # 3600 ranges with 5 cm of noise determine each of 8 or 32 coefficients to 1 mm or 3 mm.
    assert max(error) < (0.008 if own else 0.004)


@pytest.mark.slow
@pytest.mark.parametrize("own", [False, True])
def test_another_flight_is_corrected_by_directions_from_its_poses(own, tmp_path):
    recipe = replace(SHORT, own=own)
    first, second = written(tmp_path / "a.uwb", recipe, 3), written(tmp_path / "b.uwb", recipe, 3, 1)
    for name, more in (("none", ["--pattern", "none"]), ("auto", [])):
        done = succeed("calib", "fit", first, "-o", tmp_path / f"{name}.json", "--between", 0, *more)
        assert ("over direction" in done.stdout) == (name == "auto")
    without, known = (calib.load_calibration(tmp_path / f"{name}.json") for name in ("none", "auto"))
    judged, corrected = calib.evaluate(second, known).overall, known.apply(calib.load_ranges(second)).corrected_m
    # 4 cm of the 6 cm are noise.
    assert judged.full.std_m < 0.75 * calib.evaluate(second, without).overall.full.std_m
    assert 0.92 < judged.inside_95 < 0.98
    assert not succeed("calib", "apply", second, "-c", tmp_path / "auto.json", "-o", tmp_path / "c.uwb").stderr
    assert uwblink.load(tmp_path / "c.uwb").exchanges.range_m == pytest.approx(corrected, abs=1e-9)
    uwblink.Contents(exchanges=uwblink.load(second).exchanges).save(tmp_path / "blind.uwb")
    with pytest.warns(calib.errors.DirectionWarning, match="^blind.uwb: 100 % of the ranges have no known direction"):
        calib.apply(tmp_path / "blind.uwb", known, tmp_path / "d.uwb")


SOUND = {
    "plain": Recipe(pattern_m=0.0),
    "short": Recipe(pattern_m=0.0, seconds=20.0, robots=3),
    "errors that last": Recipe(pattern_m=0.0, wander_m=0.04),
    "walls": Recipe(pattern_m=0.0, wall_m=0.05, wander_m=0.02),
    "errors of places": Recipe(pattern_m=0.0, robots=1, anchors=8, loop=True, room_m=0.04, wander_m=0.02),
}


@pytest.mark.parametrize("seed", [21, pytest.param(22, marks=pytest.mark.slow)])
@pytest.mark.parametrize("recipe", SOUND.values(), ids=SOUND)
def test_sound_flights_get_no_pattern(recipe, seed):
    found = fitted(recipe, seed).calibration
    assert (found.patterns, json.loads(found.to_json())["schema_version"] < 6) == ((), True)


def test_errors_by_position_are_not_taken_for_patterns():
    # A robot that heads along its loop sees every wall in one direction. A requested pattern remains small.
    (pattern,) = fitted(replace(SOUND["errors of places"], room_m=0.06), 23, pattern="shared").calibration.patterns
    assert pattern.rms_m < 0.03


@pytest.mark.slow
def test_power_that_explains_a_pattern_is_named():
    ranges = calib.load_ranges(flown(replace(TEN, pattern_m=0.0), 3)[0])
    azimuth = np.arctan2(ranges.toward[:, :, 1], ranges.toward[:, :, 0])
    of_one = np.stack([ranges.initiator, ranges.target], axis=1) == 1
    # The antenna of tag 1 is stronger by 6 dB ahead, and only its ranges grow with power.
    louder = 6.0 * np.sum(np.cos(azimuth) * of_one, axis=1)
    powers = {name: getattr(ranges, name) + louder for name in ("fpp1_dbm", "fpp2_dbm")}
    order = np.argsort(np.argsort(sum(powers.values()))) / len(ranges)
    found = calib.fit(replace(ranges, raw_m=ranges.raw_m + 0.12 * order * of_one.any(axis=1), **powers), between_m=0.0)
    assert [said for said in found.warnings if "may be an effect of power" in said]
    assert found.calibration.patterns
    assert not [said for said in fitted(TEN, 3).warnings if "may be an effect of power" in said]


@pytest.mark.parametrize("seed", [31, pytest.param(32, marks=pytest.mark.slow)])
@pytest.mark.parametrize("fault", ["scale of true distances", "time offset of true distances"])
def test_wrong_true_distances_are_not_taken_for_a_pattern(fault, seed):
    # Robots that head along their loops see distant anchors in one direction, and poses that are late are behind them.
    data = flown(Recipe(pattern_m=0.0, robots=2, anchors=6, loop=True), seed)[0]
    larger, later_ns = (1.03, 0) if "scale" in fault else (1.0, 20_000_000)
    poses = replace(data.poses, position_m=larger * data.poses.position_m, time_ns=data.poses.time_ns + later_ns)
    found = calib.fit(replace(data, poses=poses), between_m=0.0)
    assert not found.calibration.patterns
    assert fault in "".join(one.fault for one in found.findings)


@pytest.mark.parametrize("wrong", [True, False])
def test_a_wrong_lever_arm_is_named_beside_its_pattern(wrong):
    data = flown(Recipe(pattern_m=0.0 if wrong else 0.2, own=True, robots=3, anchors=4), 33)[0]
    # The lever arm is wrong by 22 cm.
    arms = [one.lever_arm_m + np.array([0.2, 0.1, 0.0]) * (wrong and one.tag == 2) for one in data.tags]
    tags = [replace(one, lever_arm_m=tuple(arm)) for one, arm in zip(data.tags, arms, strict=True)]
    found = calib.fit(replace(data, tags=tags), between_m=0.0)
    assert found.calibration.patterns
    named = [one.evidence for one in found.findings if one.fault == "pattern or wrong lever arm"]
    assert [bool(re.search(r"tag 2: .* by 2[0-4] cm", text)) for text in named] == [True] * wrong


@pytest.mark.parametrize("name", ["shared", "tag"])
def test_a_pattern_that_attitudes_do_not_excite_is_refused_with_the_flight_that_would(tmp_path, name):
    still = written(tmp_path / "still.uwb", replace(SHORT, turning=0.0), 5)
    words = ("calib", "fit", still, "-o", tmp_path / "x.json", "--pattern", name)
    refuse(*words, status=1, naming=["tags 1, 2, 3, 4", "makes a full turn"])
    assert not (tmp_path / "x.json").exists()
    assert fitted(replace(SHORT, turning=0.0), 5).calibration.patterns == ()


def test_a_pattern_needs_directions_and_enough_ranges():
    whole = calib.load_ranges(flown(SHORT, 5)[0])
    blind = replace(whole, toward=np.full_like(whole.toward, np.nan))
    for some, name, said in (
        (blind, "shared", "no directions are known"),
        (whole[:300], "tag", "too few ranges for a pattern; at least 960"),
    ):
        with pytest.raises(calib.UnanswerableError, match=said):
            calib.fit(some, pattern=name)
    assert calib.fit(whole[:300]).calibration.patterns == ()


@pytest.mark.parametrize("name", ["pattern", "temperature"])
@pytest.mark.parametrize(
    "settings", [{"sequential": True}, {"constants": "pair"}, {"use": "receptions"}], ids=lambda one: next(iter(one))
)
def test_fits_that_cannot_have_a_pattern_or_slope_refuse_it(settings: dict[str, Any], name: str):
    with pytest.raises(calib.BadInputError, match=next(iter(settings))):
        calib.FitSettings(**settings | {name: "shared"})
    with pytest.raises(calib.BadInputError, match=name):
        calib.fit_from_ranges(flown(SHORT, 5)[0], **dict[str, Any]({name: "shared"}))


def test_ranges_are_corrected_by_two_directions_or_warn():
    known, there = fitted(SHORT, 3).calibration, calib.load_ranges(flown(SHORT, 3, 1)[0])[:500]
    assert "over direction" in repr(known)
    x, y, z = np.moveaxis(there.toward.astype(float), 2, 0)
    columns = (there.raw_m, there.fpp1_dbm, there.fpp2_dbm, there.initiator, there.target)
    weights = (there.weight_initiator, there.weight_target)
    angles = {"azimuth_deg": np.degrees(np.arctan2(y, x)).T, "elevation_deg": np.degrees(np.arcsin(z)).T}
    corrected = known.correct(*columns, weights=weights, **{name: tuple(both) for name, both in angles.items()})
    assert corrected.range_m == pytest.approx(known.apply(there).corrected_m, abs=1e-5)
    blind = known.correct(*columns, weights=weights)
    plain = replace(known, patterns=()).correct(*columns, weights=weights)
    assert blind.range_m == pytest.approx(plain.range_m, abs=1e-12)
    error = blind.range_m - there.truth_m
    assert np.std(error / blind.sigma_total_m) == pytest.approx(1.0, abs=0.1)
    assert np.std(error / plain.sigma_total_m) > 1.2
    one = known.correct(3.0, -85.0, -86.0, 1, 2, azimuth_deg=(30.0, 200.0))
    assert isinstance(one.range_m, float)
    assert one.range_m != known.correct(3.0, -85.0, -86.0, 1, 2).range_m
    bare = replace(there, toward=np.full_like(there.toward, np.nan))
    low, high = known.quantiles(bare, (0.025, 0.975)).T
    assert 0.92 < np.mean((error > low) & (error < high)) < 0.98
    some = np.where(np.arange(500)[:, None, None] < 300, bare.toward, there.toward)
    with pytest.warns(calib.errors.DirectionWarning, match="^memory: 60 % of the ranges have no known direction"):
        calib.evaluate(replace(there, toward=some), known)
    with pytest.raises(calib.BadInputError, match="azimuth_deg"):
        known.correct(3.0, -85.0, -86.0, 1, 2, azimuth_deg=(1.0, 2.0, 3.0))


def test_the_report_draws_patterns_with_their_bands_at_the_level_of_flight():
    known, flown_ranges = fitted(SHORT, 3).calibration, fitted(SHORT, 3).ranges
    *_, picture = sections.SECTIONS["patterns"](results.Results(calibration=known, training=[flown_ranges]))
    assert isinstance(picture, Picture)
    (axes,), (pattern,) = picture.draw(7.0).axes, known.patterns
    # Robots tilt: the median of the flown elevations, the 10 % and 90 % quantiles, and the circle of zero.
    *lines, zero = axes.lines
    up = np.radians([float(line.get_label()[10:-1].replace("−", "-")) for line in lines])
    level = np.quantile(seen(flown_ranges, (1, 2, 3, 4))[:, 2], (0.5, 0.1, 0.9))
    assert np.sin(up) == pytest.approx(level, abs=0.01)
    assert not np.any(zero.get_ydata())
    around = np.asarray(lines[0].get_xdata())
    for line, one in zip(lines, up, strict=True):
        toward = [np.cos(around) * np.cos(one), np.sin(around) * np.cos(one), np.full(len(around), np.sin(one))]
        values = pattern.values(np.transpose(toward))
        assert line.get_ydata() == pytest.approx(100 * values @ pattern.coefficients_m, abs=0.1)
    edges = axes.collections[0].get_paths()[0].vertices[:, 1]
    assert np.ptp(edges) > np.ptp(lines[0].get_ydata()) + 196 * pattern.std_m(values).min()
    # A page shows values at the pointer for straight axes, and not for these. Without ranges there is one line.
    one = sections.SECTIONS["patterns"](results.Results(calibration=known))[-1].draw
    assert (len(one(3.5).axes[0].lines), b"names" in drawn(one, 7.0, ["svg"])["svg"]) == (2, False)
    assert sections.SECTIONS["patterns"](results.Results(calibration=replace(known, patterns=()))) == []


def test_a_stream_knows_no_directions_and_its_total_sigma_contains_the_pattern(tmp_path):
    fitted(SHORT, 3).calibration.save(tmp_path / "known.json")
    path, how = written(tmp_path / "second.uwb", TEN, 3, 1), {"calibration": tmp_path / "known.json"}
    rows = list(uwblink.stream(path, speed=np.inf, **how))
    error = np.array([one.corrected_m for one in rows]) - calib.load_ranges(path).truth_m
    assert np.std(error / [one.more["sigma_total_m"] for one in rows]) == pytest.approx(1.0, abs=0.1)
    assert np.std(error / [one.sigma_m for one in rows]) > 1.2
    with pytest.raises(ValueError, match="without patterns over direction"):
        uwblink.stream(path, use="receptions", **how)


@pytest.mark.slow
@pytest.mark.parametrize("own", [False, True])
def test_a_tag_that_is_added_has_the_pattern_that_others_share_or_one_that_is_unknown(own, tmp_path):
    recipe = replace(TEN, own=own, robots=5)
    ranges, there = (calib.load_ranges(flown(recipe, 3, k)[0]) for k in (0, 1))
    known = calib.fit(ranges[(ranges.initiator != 5) & (ranges.target != 5)], between_m=0.0).calibration
    assert [one.tags for one in known.patterns] == ([(1,), (2,), (3,), (4,)] if own else [(1, 2, 3, 4)])
    known.save(tmp_path / "known.json")
    second = written(tmp_path / "second.uwb", recipe, 3, 1)
    done = run("calib", "add-tag", second, "-c", tmp_path / "known.json", "--tag", 5, "-o", tmp_path / "five.json")
    assert (done.returncode, "tag 5: its pattern over direction" in done.stderr) == (0, own)
    added, planted = calib.load_calibration(tmp_path / "five.json"), flown(recipe, 3)[0].meta["planted"]["delays_ns"]
    off = [added.delays_ns[tag] - planted[str(tag)] for tag in (1, 2, 3, 4, 5)]
    # The common part of all delays belongs to the curve; of the rest, 10 ps are 1.5 mm of a range.
    assert off[4] - np.mean(off) == pytest.approx(0, abs=0.02 + 0.1 * own)
    of_five = there[(there.initiator == 5) | (there.target == 5)]
    error = added.apply(of_five).corrected_m - of_five.truth_m
    assert np.std(error) < (0.065 if own else 0.045)
    assert np.std(error / added.apply(of_five).sigma_total_m) == pytest.approx(1.0, abs=0.1)
    with pytest.raises(calib.UnanswerableError, match="but only 0 exchanges have known directions"):
        calib.add_tag(replace(there, toward=np.full_like(there.toward, np.nan)), known, 5)


@pytest.mark.slow
def test_delays_of_calibrations_with_patterns_are_compared_for_the_same_directions(tmp_path):
    known, again = (calib.fit(flown(TEN, 3, k)[0], between_m=0.0).calibration for k in (0, 1))
    found, (pattern,) = calib.compare(known, again), known.patterns
    assert (found.same, found.pattern_probability > 0.01, found.pattern_rms_m < 0.015) == (True, True, True)
    # The same pattern about another centre, one for each tag: delays refer to other directions.
    centres = dict(zip((1, 2, 3, 4), np.random.default_rng(1).normal(0, 0.5, (4, 8)), strict=True))
    moved_m = {tag: float((centre - pattern.centre) @ pattern.coefficients_m) for tag, centre in centres.items()}
    elsewhere = replace(
        known,
        delays_ns={tag: delay - 2 / 0.299702547 * moved_m[tag] for tag, delay in known.delays_ns.items()},
        patterns=tuple(replace(pattern, tags=(tag,), centre=tuple(one.tolist())) for tag, one in centres.items()),
    )
    there = calib.load_ranges(flown(TEN, 3, 1)[0])
    assert elsewhere.apply(there).corrected_m == pytest.approx(known.apply(there).corrected_m, abs=1e-5)
    for found in (calib.compare(known, elsewhere), calib.compare(elsewhere, known)):
        assert [*found.difference_ns.values(), found.pattern_rms_m] == pytest.approx([0] * 5, abs=1e-9)
    turned = replace(pattern, coefficients_m=pattern.coefficients_m[::-1])
    for name, patterns in (("known", (pattern,)), ("turned", (turned,)), ("none", ())):
        replace(known, patterns=patterns).save(tmp_path / f"{name}.json")
    told = run("calib", "compare", "known.json", "turned.json", cwd=tmp_path).stdout
    assert float(told.split("rms apart, probability ")[1].split()[0]) < 1e-3
    said = "tags 1, 2, 3, 4 have a pattern over direction in only one"
    refuse("calib", "compare", "known.json", "none.json", cwd=tmp_path, status=1, naming=[said])


def test_places_without_attitudes_give_no_direction():
    """Bodies without attitudes, as in tables of positions: sigma includes the effect of unknown directions."""
    known, (found, _) = fitted(SHORT, 3).calibration, flown(SHORT, 3, 1)
    when, names = np.unique(found.poses.time_ns), [f"tag{one.tag}" for one in found.tags]
    places = [antennas_m(found.poses, found.tags, np.full(len(when), one.tag), when) for one in found.tags]
    poses = uwblink.Poses.from_arrays(
        np.tile(when, len(names)), np.repeat(names, len(when)), np.concatenate(places)
    ).in_time_order()
    tags = [replace(one, body=name, lever_arm_m=(0.0, 0.0, 0.0)) for one, name in zip(found.tags, names, strict=True)]
    ranges = calib.load_ranges(uwblink.Contents(exchanges=found.exchanges, poses=poses, tags=tags))
    corrected, (pattern,) = known.apply(ranges), known.patterns
    blind = known.apply(replace(ranges, toward=np.full_like(ranges.toward, np.nan)))
    assert np.array_equal(corrected.corrected_m, blind.corrected_m)
    missing = np.sqrt(corrected.sigma_total_m**2 - known.apply(calib.load_ranges(found)).sigma_total_m ** 2)
    assert np.median(missing) == pytest.approx(np.sqrt(2) * pattern.rms_m, rel=0.1)
