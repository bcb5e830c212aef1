"""Segments through obstacles and bodies, against sampling."""

import numpy as np
import pytest

from uwbsim.scenario.bodies import Obstacle, Shadow
from uwbsim.world.diffraction import box_chords_m, box_loss, ellipsoid_chord_m

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
    loss, excess = box_loss([BOX, own], np.array([[-1.0, 1.0, 1.0]]), np.array([[4.0, 1.0, 1.0]]))
    assert loss[0] == pytest.approx(80.0 * 1.0 + 10.0 * 0.5)
    assert excess[0] == pytest.approx(1.4 * 1.0 + 2.0 * 0.5)
