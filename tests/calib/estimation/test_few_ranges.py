"""Recordings of few ranges a pair: that the fit settles, and a real flight among obstacles."""

import tarfile

import numpy as np
import pytest

import calib
from benchmarks.worlds import CLEAN, make
from calib.calibration.formats import read_miluv
from tests.shared_data import shared
from uwblink.importers import read_source

pytestmark = pytest.mark.slow

FEW = "twelve tags, six ranges a pair"


@pytest.mark.parametrize("seed", [104, 105])
def test_few_ranges_settle(seed):
    # These two went on for hundreds of steps in directions that no range determines.
    found = calib.fit(make(CLEAN[FEW], seed).ranges)
    assert found.success


def test_a_real_flight_among_obstacles_agrees_with_the_published_delays(tmp_path):
    with tarfile.open(shared("miluv_cirObstacles_3_random_0.tar.xz")) as archive:
        archive.extractall(tmp_path, filter="data")
    ranges = calib.load_ranges(read_source(tmp_path / "cirObstacles_3_random_0", importer="miluv"))
    published = read_miluv(shared("miluv_published_calibration.json"))
    known = calib.fit(ranges, loss="cauchy").calibration
    tags = list(known.uncertainty.tags)
    centre = np.eye(len(tags)) - 1 / len(tags)
    error = centre @ [known.delays_ns[tag] - published.delays_ns[tag] for tag in tags]
    std = np.sqrt(np.diag(centre @ np.array(known.uncertainty.delays_ns2) @ centre))
    ours, theirs = (each.apply(ranges).delay_corrected_m for each in (known, published))
    assert np.sqrt(np.mean((error / std) ** 2)) < 1.5
    assert np.std(ours - theirs) < 0.06


def of_twelve_tags(count, seed):
    rng = np.random.default_rng(seed)
    delay_ns = np.random.default_rng(99).normal(0, 0.4, 12)
    ends = np.array([rng.choice(12, 2, replace=False) for _ in range(count)])
    fpp, truth = rng.uniform(-95, -82, (2, count)), rng.uniform(1, 8, count)
    reflected = np.where(rng.random(count) < 0.05, rng.exponential(0.4, count), 0)
    return calib.Ranges.from_arrays(
        truth - 0.5e-9 * 299_792_458 * delay_ns[ends].sum(axis=1) + rng.normal(0, 0.05, count) + reflected,
        initiator=ends[:, 0],
        target=ends[:, 1],
        fpp1_dbm=fpp[0],
        fpp2_dbm=fpp[1],
        truth_m=truth,
        time_ns=200_000_000 * np.arange(count),
    )


def test_what_few_ranges_leave_unknown_of_delays_is_in_the_intervals_of_other_ranges():
    inside = [
        calib.evaluate(of_twelve_tags(3000, 50 + seed), calib.fit(of_twelve_tags(250, seed), between_m=0.0).calibration)
        for seed in range(20, 30)
    ]
    # The mean of ten shares, of standard deviation 3 percentage points each.
    assert np.mean([each.overall.inside_95 for each in inside]) == pytest.approx(0.95, abs=0.02)
