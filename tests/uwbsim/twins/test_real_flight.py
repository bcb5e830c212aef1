"""The twin of a flight that nobody here made: one of MILUV among obstacles, with the calibration published with it.

317 exchanges of 48 pairs in 78 s. Tolerances are those asked of a twin: 10 % of medians and 90 % quantiles, 0.1 of
autocorrelations; powers in dB, of which 10 % would say nothing. What is not met stands in docs/accuracy.md.
"""

import tarfile

import numpy as np
import pytest

import uwbsim
from calib.calibration.formats import read_miluv
from tests.shared_data import shared
from uwblink.importers import read_source


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("miluv")
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(folder, filter="data")
    flight = read_source(next(folder.iterdir()), importer="miluv")
    twin = uwbsim.twin(flight, read_miluv(shared("miluv_published_calibration.json")))
    return twin, {one.name: one for one in twin.compare(seeds=4)}


def test_replies_are_those_measured(compared):
    one = compared[1]["reply dt32"]
    assert (one.median_simulated, one.high_simulated) == pytest.approx(
        (one.median_measured, one.high_measured), rel=0.1
    )
    assert one.alike


def test_residuals_are_those_measured(compared):
    one = compared[1]["residual of calibrated ranges"]
    assert one.high_simulated == pytest.approx(one.high_measured, rel=0.1)
    # The median is 0.9 cm with a standard error of 0.9 cm: the same flight again would miss ten per cent of it.
    assert one.median_simulated == pytest.approx(one.median_measured, abs=0.015)
    assert one.lag1_simulated == pytest.approx(one.lag1_measured, abs=0.1)
    assert one.alike


def test_carrier_readings_are_those_measured(compared):
    for name in ("carrier reading at initiator", "skew by dt64/dt53"):
        one = compared[1][name]
        assert one.alike
        assert one.high_simulated == pytest.approx(one.high_measured, rel=0.15)
    assert compared[1]["sum of both carrier readings"].median_simulated == pytest.approx(-0.267, rel=0.1)


def test_powers_are_those_measured(compared):
    for end in ("target", "initiator"):
        one = compared[1][f"first-path power at {end}"]
        assert one.median_simulated == pytest.approx(one.median_measured, abs=1.5)
        assert one.high_simulated == pytest.approx(one.high_measured, abs=1.0)
        assert one.alike


def test_robots_warm_up_and_it_is_seen(compared):
    """Clocks of flying robots change by up to 4 ppm in the first 40 s; those of anchors hardly do."""
    twin = compared[0]
    assert twin.found["warm_up_s"] is not None
    change = np.array([tag.warm_up_ppm for tag in twin.scenario.tags])
    flying = np.array([tag.body.startswith("ifo") for tag in twin.scenario.tags])
    # Only differences between tags are observed.
    assert np.max(np.abs(change[flying] - np.median(change[~flying]))) > 2.0
    assert np.ptp(change[~flying]) < 1.0


def test_what_such_a_flight_cannot_tell_is_said(compared):
    words = " ".join(compared[0].unknown)
    assert "How long reflections last (life_s): a pair ranges again after" in words
    assert "Why dt64/dt53 is off by -0.11 ppm" in words
