"""Errors that depend on positions are common to all ranges between two bodies: they are found, named, and in the
intervals.
"""

import re
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from scipy import signal

import calib
from benchmarks.trajectories import scenario
from calib.checks.limits import power_levels_db
from calib.data.ranges import concatenate
from tests.calib.fitting.fields import ranges_with_field
from tests.calib.synthetic import DELAYS_NS, about_their_mean, bias_m, lifted, ranges


def judged(ranges, planted):
    """Return whether errors of places are named, and errors of delays about their mean (tags,) in standard errors."""
    found = calib.fit(ranges)
    error, std = about_their_mean(found.calibration, dict(enumerate(planted, 1)))
    return any(warning.startswith("errors depend on places") for warning in found.warnings), error / std


@pytest.mark.slow
def test_offsets_between_bodies_that_last_are_in_the_intervals_and_named():
    worlds = [ranges_with_field(seed, bodies=5, seconds=25.0, field_m=0.01, between_m=0.03) for seed in range(2)]
    seeing = [judged(*world) for world in worlds]
    # If the bodies were unknown, pairs would count as independent, and intervals would hold in half of the cases.
    blind = [judged(replace(ranges, bodies=()), planted) for ranges, planted in worlds]
    assert [named for named, _ in seeing + blind] == [True, True, False, False]
    # The delays on one body have the same error, so twenty delays are ten independent values.
    inside, inside_blind = (np.mean(np.abs([scores for _, scores in some]) < 1.96) for some in (seeing, blind))
    assert inside > 0.85 > 0.8 > inside_blind


@pytest.mark.slow
def test_intervals_with_walls_between_five_bodies_hold_and_are_not_too_wide():
    """Walls of 3 cm between five bodies move delays by the least squares solution of their offsets."""
    worlds = [ranges_with_field(seed, bodies=5, seconds=25.0, between_m=0.03) for seed in range(11_200, 11_216)]
    found = [about_their_mean(calib.fit(ranges).calibration, dict(enumerate(planted, 1))) for ranges, planted in worlds]
    error, std = np.swapaxes(found, 0, 1)
    # Both tags of a body have the same error: of 80 independent values 88 % or fewer are inside with p = 0.01.
    assert np.mean(np.abs(error / std) < 1.96) > 0.88
    both = np.array([np.isin(range(5), pair) for pair in combinations(range(5), 2)])
    moved = (np.eye(5) - 1 / 5) @ np.linalg.pinv(0.5 * 0.2998 * both)
    known = 0.03 * np.sqrt(np.mean(np.sum(moved**2, axis=1)))
    # Student's t with five degrees of freedom, those of the size of offsets, has a factor of 1.3.
    assert 1.0 < np.median(std) / known < 1.42


@pytest.mark.slow
def test_ranges_between_two_bodies_that_are_all_reflected_have_little_weight():
    """They are noisy, too: with the standard deviation of other offsets, they would move all delays."""
    errors = []
    for seed in range(11_600, 11_606):
        ranges, planted = ranges_with_field(seed, bodies=4, seconds=25.0, between_m=0.02)
        detours = np.random.default_rng(seed).normal(0.3, 0.15, len(ranges))
        detours *= np.all(np.isin(ranges.ends, [1, 2, 3, 4]), axis=1)
        found = calib.fit(replace(ranges, raw_m=ranges.raw_m + detours)).calibration
        errors.append(about_their_mean(found, dict(enumerate(planted, 1)))[0])
    # Walls of 2 cm alone move delays by 0.1 ns; with equal weights the errors are 0.17 ns.
    assert np.sqrt(np.mean(np.square(errors))) < 0.14


def test_offsets_between_bodies_may_change_until_another_recording():
    ranges, _ = ranges_with_field(11_300, bodies=5, seconds=25.0, between_m=0.2)
    assert 0.1 < calib.fit(ranges).calibration.errors.between_m < 0.4


def test_errors_that_come_and_go_are_named_where_bodies_are_as_many_as_their_pairs():
    # With three bodies and three pairs, delays absorb constant errors, and only variable ones can be found.
    named, scores = judged(*ranges_with_field(1, bodies=3, seconds=40.0, field_m=0.02, wave_m=4.0))
    assert named
    assert np.all(np.abs(scores) < 1.96)


@pytest.mark.parametrize("bodies", [3, 4])
def test_sound_flights_keep_their_intervals(bodies):
    ranges, _ = ranges_with_field(2, bodies=bodies, seconds=25.0)
    result, alone = calib.fit(ranges), calib.fit(replace(ranges, bodies=()))
    assert not [warning for warning in result.warnings if warning.startswith("errors depend on places")]
    # Four bodies determine the spread of their offsets, which is estimated near zero; three do not.
    tolerance = 0.01 if bodies == 4 else 1e-9
    assert result.calibration.delays_std_ns == pytest.approx(alone.calibration.delays_std_ns, rel=tolerance)


@pytest.mark.parametrize("seed", range(11_100, 11_103))
def test_an_offset_between_bodies_leaves_the_differences_of_their_tags_exact(seed):
    """It changes the delays of both tags on a body alike."""
    ranges, planted = ranges_with_field(seed, bodies=4, seconds=25.0, between_m=0.05)
    found = calib.fit(ranges).calibration
    error, within = [*found.delays_ns.values()] - planted, np.kron(np.eye(4), [1.0, -1.0])
    std, apart = (
        np.sqrt(np.diag(step @ np.array(found.uncertainty.delays_ns2) @ step.T)) for step in (within, np.eye(8) - 1 / 8)
    )
    assert np.max(std) < 0.2 * np.min(apart)
    # Twelve independent values, four in each of three worlds, have a larger one with p = 0.01.
    assert np.max(np.abs(within @ error) / std) < 3.3


def test_ranges_state_the_bodies_of_tags_if_recordings_agree():
    ranges, _ = ranges_with_field(3, bodies=3, seconds=2.0)
    assert dict(concatenate([ranges, ranges]).bodies) == dict(ranges.bodies)
    assert concatenate([ranges, replace(ranges, bodies=((1, "robot2"), *ranges.bodies[1:]))]).bodies == ()
    flight = calib.sample_flight()
    assert {tag.tag: tag.body for tag in flight.tags} == dict(calib.load_ranges(flight).bodies)


# Tags that read powers differently from others: found by differences between the ends of a link; the effect is stated.


SENT_DB, READ_DB = {2: -3.0}, {3: 2.0}
NOBODY: dict[int, float] = {}


def world(sent=NOBODY, read=NOBODY, noise_db=0.0, lasting=None, **more):
    """Errors depend on the powers that arrive, by 12 mm per decibel; recorded are the readings of the tags.

    Errors of readings of 1.5 dB that last for about 300 exchanges are added with a seed `lasting`.
    """
    rng, r = np.random.default_rng(3), ranges(6000, **more)
    # The path loss is equal in both directions: both powers are reduced by the same.
    bias = -0.012 * (r.fpp1_dbm + 87) - bias_m(lifted(r.fpp1_dbm, r.fpp1_dbm))
    r = replace(r, fpp2_dbm=r.fpp1_dbm, raw_m=r.raw_m + bias)

    def gain(table, tags):
        return np.array([table.get(tag, 0.0) for tag in range(8)])[tags]

    memory = np.exp(-1 / 300)
    steps = np.random.default_rng(lasting).normal(size=(8, len(r) + 3000)) * np.sqrt(1 - memory**2)
    wander_db = 1.5 * (lasting is not None) * signal.lfilter([1], [1, -memory], steps)[:, 3000:]

    def readings(power_dbm, sender, reader):
        noise = noise_db * rng.normal(size=len(r)) + wander_db[reader, np.arange(len(r))]
        return power_dbm + gain(sent, sender) + gain(read, reader) + noise

    return replace(
        r,
        fpp1_dbm=readings(r.fpp1_dbm, r.initiator, r.target),
        fpp2_dbm=readings(r.fpp2_dbm, r.target, r.initiator),
    )


def test_levels_are_exact_without_noise_and_as_near_as_they_say_with_it():
    exact, noisy = (power_levels_db(world(SENT_DB, READ_DB, noise_db=noise)) for noise in (0.0, 1.0))
    # Low transmit power has the same effect as high readings.
    expected = {1: 0, 2: 3, 3: 2, 7: 0}
    assert {tag: level for tag, (level, _) in exact.items()} == pytest.approx(expected, abs=1e-9)
    level, std = np.array([noisy[tag] for tag in expected]).T
    assert 0.005 < std.min() < std.max() < 0.05
    assert np.all(np.abs(level - [*expected.values()]) < 5 * std)


def test_ranges_without_powers_have_no_levels():
    bare = replace(world(), fpp2_dbm=np.full(6000, np.nan))
    assert power_levels_db(bare) == {}
    assert "power levels of tags" not in [one.fault for one in calib.fit(bare, delays_only=True).findings]


def test_a_tag_that_reads_too_high_is_named_with_what_its_delay_holds():
    result = calib.fit(world(read=READ_DB, noise_db=0.3, tail=0.0, noise_m=0.02))
    (said,) = [warning for warning in result.warnings if "differ from the others" in warning]
    assert said.startswith("powers of tag 3 (+2.0 dB) differ from the others")
    held_ps = float(re.search(r"up to (\d+) ps", said)[1])
    away = {tag: result.calibration.delays_ns[tag] - delay for tag, delay in DELAYS_NS.items()}
    # A common shift of all is the constant of the curve, so the others are the reference; a fifth for the bend of the
    # curve.
    assert 1e3 * abs(away.pop(3) - np.mean([*away.values()])) == pytest.approx(held_ps, rel=0.2)
    assert held_ps > 50


@pytest.mark.parametrize("seed", range(11_000, 11_004))
def test_errors_of_readings_that_last_are_no_difference_of_tags(seed):
    """Standard errors of independent readings would be a tenth of the errors of levels."""
    sound, faulty = (world(read=read, lasting=seed) for read in (NOBODY, {3: 4.0}))
    assert all(abs(level) < 5 * std for level, std in power_levels_db(sound).values())
    assert "power levels of tags" not in [one.fault for one in calib.fit(sound).findings]
    (named,) = [one for one in calib.fit(faulty).findings if one.fault == "power levels of tags"]
    assert named.evidence.startswith("powers of tag 3 (+")
    assert named.p_value == pytest.approx(0, abs=1e-4)


@pytest.mark.slow
def test_differing_powers_are_named_beside_a_fault_that_they_imitate():
    """Here they also look like a wrong scale of distances, which makes intervals four times as wide."""
    fitted = calib.fit(scenario("lasting_reflections/hall.toml", 10_000, 40.0))
    found = {one.fault: one.evidence for one in fitted.findings}
    assert "tags 2 (+3.0 dB), 3 (+1.5 dB), 5 (+3.0 dB)" in found["power levels of tags"]
    assert "scale of true distances" in found


# Lengths and powers in other units than metres and dBm: they are not fitted, and the unit is named.


def hardly_moving(seed=1):
    """Return ranges of bodies that move by one or two decimetres, so that the slope over distance shows no unit."""
    some = ranges(n=900, seed=seed)
    truth = 2.5 + 0.2 * np.random.default_rng(seed).random(len(some))
    return replace(some, raw_m=some.raw_m - some.truth_m + truth, truth_m=truth)


@pytest.mark.parametrize(
    ("column", "times", "unit", "more"),
    [
        ("truth_m", 1000, "millimetres", {}),
        ("truth_m", 100, "centimetres", {"loss": "l2"}),
        ("raw_m", 1000, "millimetres", {"delays_only": True}),
        ("raw_m", 1000, "millimetres", {"sequential": True}),
    ],
)
def test_another_unit_is_refused_and_named(column, times, unit, more):
    some = hardly_moving()
    calib.fit(some, **more)
    with pytest.raises(calib.UnanswerableError, match=unit) as refused:
        calib.fit(replace(some, **{column: getattr(some, column) * times}), **more)
    assert ("true distances are probably" in str(refused.value)) == (column == "truth_m")


def test_boards_that_were_programmed_with_no_delay_are_fitted():
    some = ranges(n=900)
    found = calib.fit(replace(some, raw_m=some.raw_m + 514e-9 * 299_702_547.0))
    assert all(-516 < delay < -512 for delay in found.calibration.delays_ns.values())
    assert [said for said in found.warnings if "antenna delays" in said]
