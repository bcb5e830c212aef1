"""Reflection coefficients against closed forms."""

import numpy as np
import pytest

from uwbsim.scenario.bodies import Material
from uwbsim.world.diffraction import fresnel, permittivity, roughness_factor

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
    wavelength_m = 299_702_547 / 3993.6e6
    assert -20 * np.log10(abs(np.exp(-2j * np.pi / wavelength_m * n))) == pytest.approx(80.0, rel=1e-9)
    assert n.real == pytest.approx(2.4)


def test_roughness_takes_what_rayleigh_says():
    """Path differences of 2 h cos(theta) spread phases by 4 pi h cos(theta)/wavelength; Gaussian ones average so."""
    rng, wavelength_m = np.random.default_rng(1), 299_702_547 / 3993.6e6
    for cosine in (1.0, 0.5):
        phase = 4 * np.pi * rng.normal(0, 0.006, 400_000) * cosine / wavelength_m
        expected = abs(np.mean(np.exp(1j * phase)))
        assert roughness_factor(0.006, np.array([cosine]))[0] == pytest.approx(expected, abs=0.005)
