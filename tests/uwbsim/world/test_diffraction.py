"""Waves at boxes, bodies and faces: chords by sampling, shadows by Fresnel's integral, reflections by Snell's law."""

import numpy as np
import pytest
from scipy.integrate import quad

from uwbsim.scenario.bodies import Material, Obstacle, Shadow
from uwbsim.world.diffraction import (
    blocked_fraction,
    body_gain,
    box_chords_m,
    box_loss,
    boxes_blocked,
    edge_gain,
    ellipsoid_chord_m,
    fresnel,
    permittivity,
    roughness_factor,
)

WAVELENGTH_M = 299_702_547 / 3993.6e6
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


def knife_edge_db(nu):
    """|1/(1 - j) times the integral from nu on of exp(-j pi u^2/2)|: half of the whole less the part up to nu."""
    across = 0.5 - quad(lambda u: np.cos(np.pi * u * u / 2), 0, nu, limit=2000)[0]
    along = 0.5 - quad(lambda u: np.sin(np.pi * u * u / 2), 0, nu, limit=2000)[0]
    return -20 * np.log10(np.hypot(across, along) / np.sqrt(2))


def itu_db(nu):
    """Equation 31 there."""
    return 6.9 + 20 * np.log10(np.sqrt((nu - 0.1) ** 2 + 1) + nu - 0.1)


@pytest.mark.parametrize("nu", [-2.0, -0.7, 0.0, 0.4, 1.0, 2.4, 5.0])
def test_what_a_half_plane_leaves_is_fresnels_integral(nu):
    left = abs(1 - blocked_fraction(np.array([nu]))[0])
    assert -20 * np.log10(left) == pytest.approx(knife_edge_db(nu), abs=0.02)


@pytest.mark.parametrize("nu", [-0.5, 0.0, 1.0, 2.4, 10.0])
def test_the_approximation_for_bodies_is_that_of_the_itu(nu):
    assert -20 * np.log10(edge_gain(np.array([nu]))[0]) == pytest.approx(itu_db(nu), abs=1e-9)
    assert itu_db(nu) == pytest.approx(knife_edge_db(nu), abs=0.8)


@pytest.mark.parametrize("above_m", [-0.5, -0.1, 0.0, 0.05, 0.2, 0.6])
def test_a_long_thin_wall_is_a_knife_edge(above_m):
    """Its upper edge lies this high above the line of sight, 2 m from one end and 3 m from the other."""
    wall = Obstacle(min_m=(1.999, -50, -50), max_m=(2.001, 50, above_m), material="metal")
    cover, edge = boxes_blocked([wall], np.array([[0.0, 0, 0]]), np.array([[5.0, 0, 0]]))
    nu = above_m * np.sqrt(2 * 5 / (WAVELENGTH_M * 2 * 3))
    assert edge[0, 0] == pytest.approx(nu, rel=1e-3, abs=1e-6)
    assert -20 * np.log10(abs(1 - cover[0, 0])) == pytest.approx(knife_edge_db(nu), abs=0.6)
    if nu > -0.7:
        assert -20 * np.log10(abs(1 - cover[0, 0])) == pytest.approx(itu_db(nu), abs=1.0)


def test_edges_are_where_the_line_meets_them_from_any_direction():
    """The line is blocked as the slabs say, whatever its direction: deep inside the cover is one, far off nothing."""
    rng = np.random.default_rng(5)
    box = Obstacle(min_m=(-1, -0.8, -0.6), max_m=(1, 0.8, 0.6), material="metal")
    towards = rng.normal(size=(400, 3))
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    aside = np.cross(towards, rng.normal(size=(400, 3)))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    offset = rng.uniform(0, 3, (400, 1)) * aside
    a, b = offset - 4 * towards, offset + 4 * towards
    steps = a[:, None] + np.linspace(0, 1, 801)[:, None] * (b - a)[:, None]
    inside = np.all((steps > box.min_m) & (steps < box.max_m), axis=2).any(axis=1)
    cover, edge = boxes_blocked([box], a, b)
    clear = np.abs(edge[:, 0]) > 0.5
    np.testing.assert_array_equal((edge[:, 0] > 0)[clear], inside[clear])
    assert np.all(np.abs(cover[edge[:, 0] > 3] - 1) < 0.3)
    assert np.all(np.abs(cover[edge[:, 0] < -6]) < 0.1)


def test_boxes_that_are_not_between_the_ends_do_nothing():
    box = Obstacle(min_m=(6, -1, -1), max_m=(7, 1, 1), material="metal")
    a, b = np.zeros((2, 3)), np.array([[5.0, 0, 0], [-5.0, 0, 0]])
    assert np.all(boxes_blocked([box], a, b)[0] == 0)


BODY = Shadow(semi_axes_m=(0.3, 0.3, 0.3), loss_db_per_m=1000.0)


def past_db(height_m):
    ends = np.array([[-2.0, 0, height_m]]), np.array([[3.0, 0, height_m]])
    return -20 * np.log10(body_gain(BODY, *ends)[0])


def test_bodies_have_soft_edges():
    """A sphere covers a strip up and down and one left and right, each up to two edges; the rest goes by."""
    scale = np.sqrt(2 * 5 / (WAVELENGTH_M * 2 * 3))
    across = 1 - 2 * 10 ** (-itu_db(0.3 * scale) / 20)
    for height in (0.0, 0.15, 0.29):
        nu = (0.3 + np.array([-1, 1]) * height) * scale
        upright = 1 - np.sum(10 ** (-itu_db(nu) / 20))
        assert past_db(height) == pytest.approx(-20 * np.log10(1 - upright * across), abs=0.05)
    losses = [past_db(height) for height in np.linspace(0.0, 0.6, 61)]
    assert max(-np.diff(losses)) < 0.7, "no step over a centimetre"
    assert losses[0] > 5
    assert losses[-1] == 0


def test_a_tall_body_is_a_wall_with_two_edges():
    tall = Shadow(semi_axes_m=(0.3, 0.3, 30.0), loss_db_per_m=1000.0)
    loss = -20 * np.log10(body_gain(tall, np.array([[-2.0, 0, 0]]), np.array([[3.0, 0, 0]]))[0])
    nu = 0.3 * np.sqrt(2 * 5 / (WAVELENGTH_M * 2 * 3))
    assert loss == pytest.approx(itu_db(nu) - 20 * np.log10(2), abs=0.2), "two fields of as much each"


def test_through_a_body_goes_what_its_loss_leaves():
    mild = Shadow(semi_axes_m=(0.3, 0.3, 0.3), loss_db_per_m=10.0)
    ends = np.array([[-2.0, 0, 0]]), np.array([[3.0, 0, 0]])
    past = 10 ** (-past_db(0.0) / 20)
    assert body_gain(mild, *ends)[0] == pytest.approx(past + (1 - past) * 10 ** (-10 * 0.6 / 20), abs=1e-6)


def test_a_body_behind_an_end_does_not_shade():
    assert body_gain(BODY, np.array([[1.0, 0, 0]]), np.array([[3.0, 0, 0]]))[0] == 1


COSINES = np.cos(np.radians([0.0, 20.0, 45.0, 70.0, 89.0]))


@pytest.mark.parametrize("epsilon", [2.0, 5.24 - 0.61j, 80.0 - 4.0j])
def test_fresnels_coefficients_by_snells_law(epsilon):
    """As they stand in optics books, with the angle of refraction; the code has it by no angle at all."""
    index, incidence = np.sqrt(epsilon + 0j), np.arccos(COSINES)
    refraction = np.arcsin(np.sin(incidence) / index)
    across = -np.sin(incidence[1:] - refraction[1:]) / np.sin(incidence[1:] + refraction[1:])
    along = np.tan(incidence[1:] - refraction[1:]) / np.tan(incidence[1:] + refraction[1:])
    s, p = fresnel(epsilon, COSINES)
    np.testing.assert_allclose(s[1:], across, rtol=1e-9)
    np.testing.assert_allclose(p[1:], along, rtol=1e-9)
    assert s[0] == pytest.approx((1 - index) / (1 + index))
    assert p[0] == pytest.approx(-(1 - index) / (1 + index))


def test_nothing_comes_back_in_the_plane_at_brewsters_angle():
    s, p = fresnel(4.0, np.array([np.cos(np.arctan(2.0))]))
    assert abs(p[0]) < 1e-12
    assert abs(s[0]) == pytest.approx(3 / 5), "(n^2 - 1)/(n^2 + 1)"


def test_metal_gives_all_back():
    s, p = fresnel(permittivity("metal"), COSINES[:-1])
    np.testing.assert_allclose(s, -1, atol=2e-3)
    np.testing.assert_allclose(p, 1, atol=2e-3)


@pytest.mark.parametrize(("name", "loss_db"), [("concrete", 7.7), ("drywall", 12.7), ("glass", 7.4), ("metal", 0.0)])
def test_reflection_loss_of_materials_straight_on(name, loss_db):
    """20 log10((n + 1)/(n - 1)) of their refractive index, whose imaginary part hardly matters."""
    s, _ = fresnel(permittivity(name), np.ones(1))
    assert -20 * np.log10(abs(s[0])) == pytest.approx(loss_db, abs=0.1)


def test_a_lossy_material_loses_what_it_says():
    """A wave exp(-j k n z) through a metre of it."""
    n = np.sqrt(permittivity(Material(loss_db_per_m=80.0, index=2.4)))
    assert -20 * np.log10(abs(np.exp(-2j * np.pi / WAVELENGTH_M * n))) == pytest.approx(80.0, rel=1e-9)
    assert n.real == pytest.approx(2.4)


def test_roughness_takes_what_rayleigh_says():
    """Path differences of 2 h cos(theta) spread phases by 4 pi h cos(theta)/wavelength; Gaussian ones average so."""
    rng = np.random.default_rng(1)
    for cosine in (1.0, 0.5):
        phase = 4 * np.pi * rng.normal(0, 0.006, 400_000) * cosine / WAVELENGTH_M
        expected = abs(np.mean(np.exp(1j * phase)))
        assert roughness_factor(0.006, np.array([cosine]))[0] == pytest.approx(expected, abs=0.005)
