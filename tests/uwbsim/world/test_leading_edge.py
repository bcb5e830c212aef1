"""What a chip reads off a response: against paths summed here, and geometry by hand."""

import numpy as np
import pytest

from uwbsim.scenario.radio import Radio
from uwbsim.world.impulse_response import BEFORE, TAP_M, Paths, accumulate, detect

SENSING = (Radio(dynamic_range_db=15.0, sensitivity_dbm=-105.0), 1 / 12)
WIDTH_TAPS, EDGE_TAPS = 1.2, 1.5


def paths(*ways):
    """One link with ways (detour in metres, power in dBm, phase)."""
    detour, power, phase = np.array(ways).T
    return Paths(detour_m=detour[None], amplitude=(10 ** (power / 20) * np.exp(1j * phase))[None])


def test_responses_are_sums_of_pulses():
    rng = np.random.default_rng(2)
    detour, amplitude = rng.uniform(0, 14, (3, 40)), rng.normal(size=(3, 40, 2)) @ np.array([1, 1j])
    taps = np.arange(64)
    expected = [
        sum(
            a * np.exp(-(((taps - BEFORE - EDGE_TAPS - d / TAP_M) / WIDTH_TAPS) ** 2))
            for d, a in zip(*link, strict=True)
        )
        for link in zip(detour, amplitude, strict=True)
    ]
    real, imaginary = accumulate(Paths(detour_m=detour, amplitude=amplitude))
    # Paths lie on a 128th of a tap.
    np.testing.assert_allclose(real + 1j * imaginary, expected, atol=0.04)


@pytest.mark.parametrize("power_dbm", [-70.0, -85.0, -95.0, -104.0])
def test_a_path_alone_is_found_where_it_is_with_the_power_that_it_has(power_dbm):
    found = detect(paths((0.0, power_dbm, 0.3)), *SENSING)
    assert found.excess_m[0] == pytest.approx(0.0, abs=1e-12)
    assert found.power_dbm[0] == pytest.approx(power_dbm, abs=1e-9)
    assert found.total_dbm[0] == pytest.approx(power_dbm, abs=1e-9)


@pytest.mark.parametrize(("below_db", "first"), [(10.0, True), (13.0, True), (17.0, False), (40.0, False)])
def test_a_direct_path_counts_down_to_the_threshold_and_no_further(below_db, first):
    """The reflection by a wall 3 m beside two antennas 4 m apart takes 7.2 m.

    Taps lie up to half a tap beside a peak, where it has 1.5 dB less: so near to the threshold either may be.
    """
    detour = np.hypot(4.0, 6.0) - 4.0
    found = detect(paths((0.0, -80.0 - below_db, 0.0), (detour, -80.0, 1.0)), *SENSING)
    assert found.excess_m[0] == pytest.approx(0.0 if first else detour, abs=0.003)
    if below_db == 10:
        assert found.power_dbm[0] == pytest.approx(-90.0, abs=0.3)
    assert found.total_dbm[0] == pytest.approx(-80.0 + 10 * np.log10(1 + 10 ** (-below_db / 10)), abs=0.05)


def test_what_is_below_sensitivity_is_no_first_path():
    weak = paths((0.0, -106.0, 0.0), (2.0, -98.0, 0.0))
    assert detect(weak, *SENSING).excess_m[0] == pytest.approx(2.0, abs=0.005)
    keener = Radio(dynamic_range_db=15.0, sensitivity_dbm=-108.0)
    assert detect(weak, keener, 0.1).excess_m[0] == pytest.approx(0.0, abs=0.02)


def test_paths_nearer_than_the_pulse_fade_by_their_phase():
    """Half a wavelength apart they cancel, in phase they add; the edge moves by less than the path."""
    near = 0.01
    powers = [detect(paths((0.0, -80.0, 0.0), (near, -86.02, p)), *SENSING).power_dbm[0] for p in (0.0, np.pi)]
    np.testing.assert_allclose(powers, -80 + 20 * np.log10([1.5, 0.5]), atol=0.2)
    moved = [detect(paths((0.0, -80.0, 0.0), (0.3, -86.0, p)), *SENSING).excess_m[0] for p in np.linspace(0, 6, 13)]
    assert np.ptp(moved) > 0.02
    assert np.all(np.abs(moved) < 0.3)


def test_noise_of_the_edge_is_that_of_a_crossing_at_half_height():
    """Draw noise on the edge, find the crossing again: its spread is what was said. The peak's height is known."""
    rng = np.random.default_rng(4)
    for power_dbm in (-85.0, -97.0):
        said = detect(paths((0.0, power_dbm, 0.0)), *SENSING).noise_s[0]
        peak = 10 ** (power_dbm / 20)
        # The strongest taps lie half a tap beside the peak.
        strongest = peak * np.exp(-((0.5 / WIDTH_TAPS) ** 2))
        threshold = max(strongest * 10 ** (-15 / 20), 10 ** (-105 / 20))
        taps = np.linspace(-4, 0, 4001)
        # The noise hardly changes along the edge: in phase with the pulse it moves it up and down.
        noise = rng.normal(0, threshold / 12, 4000)
        pulse = peak * np.exp(-((taps / WIDTH_TAPS) ** 2))
        crossing = np.interp(peak / 2 - noise, pulse, taps)
        assert said == pytest.approx(np.std(crossing) * 1.0016e-9, rel=0.05)


def test_the_edge_is_at_half_the_height_of_the_first_peak():
    """A weaker path runs into a stronger one: the half height is found here on a fine grid."""
    ways = paths((0.0, -84.0, 0.0), (0.35, -80.0, 0.6))
    detour, amplitude = ways.detour_m[0] / TAP_M, ways.amplitude[0]
    taps = np.linspace(-4, 6, 100_001)
    height = np.abs(np.exp(-(((taps[:, None] - detour) / WIDTH_TAPS) ** 2)) @ amplitude)
    half = taps[np.argmax(height >= height.max() / 2)]
    expected = (half + WIDTH_TAPS * np.sqrt(np.log(2))) * TAP_M
    # The taps sample it a nanosecond apart.
    assert detect(ways, *SENSING).excess_m[0] == pytest.approx(expected, abs=0.02)
    assert 0.05 < expected < 0.35
