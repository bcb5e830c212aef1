"""Recordings of few ranges a pair: that the fit settles, and a real flight among obstacles."""

import tarfile

import numpy as np
import pytest

import calib
from benchmarks.worlds import CLEAN, make
from calib.calibration.formats import read_miluv
from tests.shared_data import shared
from uwblink.importers import read_source

FEW = "twelve tags, six ranges a pair"


@pytest.mark.parametrize("seed", [104, 105])
def test_few_ranges_settle(seed):
    # These two went on for hundreds of steps in directions that no range determines.
    found = calib.fit(make(CLEAN[FEW], seed).ranges)
    assert found.success


def test_a_loss_that_was_asked_for_is_taken():
    assert calib.fit(make(CLEAN[FEW], 1).ranges, loss="huber").calibration.loss == "huber"


def test_a_real_flight_among_obstacles_agrees_with_the_published_delays(tmp_path):
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(tmp_path, filter="data")
    ranges = calib.load_ranges(read_source(tmp_path / "cirObstacles_3_random_0", importer="miluv"))
    published = read_miluv(shared("miluv_published_calibration.json"))
    known = calib.fit(ranges, minimum_norm=True, loss="cauchy").calibration
    tags = list(known.uncertainty.tags)
    centre = np.eye(len(tags)) - 1 / len(tags)
    error = centre @ [known.delays_ns[tag] - published.delays_ns[tag] for tag in tags]
    std = np.sqrt(np.diag(centre @ np.array(known.uncertainty.delays_ns2) @ centre))
    ours, theirs = (each.apply(ranges).delay_corrected_m for each in (known, published))
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.5
    assert np.std(ours - theirs) < 0.06
