"""Obstacles, bodies and reflections, against sampling and against geometry by hand."""

import numpy as np
import pytest

from uwbsim.scenario.surroundings import Obstacle, Room, Shadow
from uwbsim.world.propagation import (
    Link,
    box_chords_m,
    ellipsoid_chord_m,
    first_path,
    reflections,
    through,
)

RNG = np.random.default_rng(3)
BOX = Obstacle(min_m=(0, 0, 0), max_m=(1, 2, 3), material="concrete")


def sampled(inside, a, b, n=20_001):
    t = (np.arange(n) + 0.5) / n
    points = a[:, None, :] + t[None, :, None] * (b - a)[:, None, :]
    return inside(points).mean(axis=1) * np.linalg.norm(b - a, axis=1)


def test_chords_of_boxes_are_what_sampling_finds():
    a, b = RNG.uniform(-2, 4, (2, 50, 3))
    found = box_chords_m([BOX], a, b)[:, 0]
    expected = sampled(lambda p: np.all((p >= BOX.min_m) & (p <= BOX.max_m), axis=-1), a, b)
    np.testing.assert_allclose(found, expected, atol=2e-3)
    assert np.count_nonzero(found) > 5


@pytest.mark.parametrize(("y", "chord"), [(1.0, 1.0), (2.5, 0.0), (-0.001, 0.0)])
def test_segments_along_an_axis(y, chord):
    a, b = np.array([[-1.0, y, 1.0]]), np.array([[3.0, y, 1.0]])
    assert box_chords_m([BOX], a, b)[0, 0] == pytest.approx(chord)


def test_chords_of_ellipsoids_are_what_sampling_finds():
    shadow = Shadow(semi_axes_m=(0.5, 1.0, 0.3), centre_m=(0.1, 0.0, -0.2))
    a, b = RNG.uniform(-1, 1, (2, 50, 3))
    scale, centre = np.array(shadow.semi_axes_m), np.array(shadow.centre_m)
    expected = sampled(lambda p: np.sum(((p - centre) / scale) ** 2, axis=-1) <= 1, a, b)
    np.testing.assert_allclose(ellipsoid_chord_m(shadow, a, b), expected, atol=2e-3)


def test_loss_and_excess_add_up_over_obstacles():
    own = Obstacle(min_m=(2, 0, 0), max_m=(2.5, 2, 3), material={"loss_db_per_m": 10.0, "index": 3.0})
    loss, excess = through([BOX, own], np.array([[-1.0, 1.0, 1.0]]), np.array([[4.0, 1.0, 1.0]]))
    assert loss[0] == pytest.approx(80.0 * 1.0 + 10.0 * 0.5)
    assert excess[0] == pytest.approx(1.4 * 1.0 + 2.0 * 0.5)


def test_reflections_have_the_lengths_of_the_two_legs():
    room = Room(min_m=(0, 0, 0), max_m=(10, 8, 3))
    a, b = np.array([[2.0, 3.0, 1.0]]), np.array([[7.0, 3.0, 1.0]])
    lengths = reflections(room, a, b).length_m[0]
    assert lengths[4] == pytest.approx(np.hypot(5, 2)), "by the floor"
    assert lengths[5] == pytest.approx(np.hypot(5, 4)), "by the ceiling"
    assert lengths[0] == pytest.approx(9.0), "by the wall behind"


def test_reflections_are_where_both_legs_make_the_same_angle():
    room = Room(min_m=(0, 0, 0), max_m=(10, 8, 3))
    a, b = RNG.uniform((0, 0, 0), room.max_m, (2, 20, 3))
    found = reflections(room, a, b)
    one, other = (found.point_m - end[:, None] for end in (a, b))
    legs = [np.linalg.norm(leg, axis=2, keepdims=True) for leg in (one, other)]
    np.testing.assert_allclose((legs[0] + legs[1])[:, :, 0], found.length_m, rtol=1e-12)
    np.testing.assert_allclose(one / legs[0], found.leaving, atol=1e-9)
    np.testing.assert_allclose(other / legs[1], found.arriving, atol=1e-9)
    for column in range(6):
        axis, wall = column // 2, (room.min_m, room.max_m)[column % 2][column // 2]
        np.testing.assert_allclose(found.point_m[:, column, axis], wall, atol=1e-9)
        np.testing.assert_allclose(found.leaving[:, column, axis], found.arriving[:, column, axis], atol=1e-9)


def test_the_first_path_is_the_direct_one_until_it_is_too_weak():
    link = Link(np.full(2, 5.0), np.zeros(2), np.array([-80.0, -110.0]), np.zeros(2))
    reflected, power = np.full((2, 1), 6.5), np.full((2, 1), -90.0)
    found = first_path(link, reflected, power, 15.0)
    np.testing.assert_allclose(found.excess_m, [0.0, 1.5])
    np.testing.assert_allclose(found.power_dbm, [-80.0, -90.0])
    np.testing.assert_allclose(found.total_dbm, 10 * np.log10([1e-8 + 1e-9, 1e-11 + 1e-9]))
