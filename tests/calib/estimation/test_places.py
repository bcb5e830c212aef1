"""Errors that belong to places are in all ranges between two bodies: they are seen, named, and in the intervals."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from calib.data.ranges import concatenate
from tests.calib.estimation.fields import ranges_with_field


def apart(result, planted):
    """Errors of delays about their mean (tags,) in ns, and their standard errors."""
    found = result.calibration
    centre = np.eye(len(planted)) - 1 / len(planted)
    error = centre @ (np.array([found.delays_ns[tag] for tag in found.uncertainty.tags]) - planted)
    return error, np.sqrt(np.diag(centre @ np.array(found.uncertainty.delays_ns2) @ centre))


def named(result):
    return [warning for warning in result.warnings if warning.startswith("errors belong to places")]


def test_offsets_between_bodies_that_last_are_in_the_intervals_and_named():
    # Without bodies being known, pairs count for independent, and intervals hold in half of the cases.
    blind, seeing = [], []
    for seed in range(2):
        ranges, planted = ranges_with_field(seed, bodies=5, seconds=25.0, field_m=0.01, between_m=0.03)
        result = calib.fit(ranges)
        assert named(result)
        unknown = calib.fit(replace(ranges, bodies=()))
        assert not named(unknown)
        seeing.append(apart(result, planted))
        blind.append(apart(unknown, planted))
    scores = [np.concatenate([error / std for error, std in some]) for some in (seeing, blind)]
    # Of twenty delays, those of a body are wrong alike: ten bodies' worth of values.
    assert np.mean(np.abs(scores[0]) < 1.96) > 0.85
    assert np.mean(np.abs(scores[1]) < 1.96) < 0.8


def test_errors_that_come_and_go_are_named_where_bodies_are_as_many_as_their_pairs():
    # Three bodies, three pairs: delays take up whatever stays, and only what comes and goes can tell.
    ranges, planted = ranges_with_field(1, bodies=3, seconds=40.0, field_m=0.02, wave_m=4.0)
    result = calib.fit(ranges)
    assert named(result)
    error, std = apart(result, planted)
    assert np.all(np.abs(error) < 1.96 * std)


@pytest.mark.parametrize("bodies", [3, 4])
def test_sound_flights_keep_their_intervals(bodies):
    ranges, _ = ranges_with_field(2, bodies=bodies, seconds=25.0)
    result, alone = calib.fit(ranges), calib.fit(replace(ranges, bodies=()))
    assert not named(result)
    assert result.calibration.delays_std_ns == pytest.approx(alone.calibration.delays_std_ns, rel=1e-9)


def test_ranges_know_the_bodies_of_their_tags_as_long_as_recordings_agree():
    ranges, _ = ranges_with_field(3, bodies=3, seconds=2.0)
    assert dict(concatenate([ranges, ranges]).bodies) == dict(ranges.bodies)
    moved = replace(ranges, bodies=((1, "robot2"), *ranges.bodies[1:]))
    assert concatenate([ranges, moved]).bodies == ()
    flight = calib.sample_flight()
    assert {tag.tag: tag.body for tag in flight.tags} == dict(calib.load_ranges(flight).bodies)
