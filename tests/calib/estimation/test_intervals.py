"""Intervals of small samples: the slopes at an optimum are smaller than those at the truth."""

from dataclasses import replace

import numpy as np

import calib
from tests.calib import synthetic


def test_intervals_of_few_ranges_hold():
    scores = []
    for seed in range(12):
        some = synthetic.ranges(n=100, noise_m=0.05, tail=0, seed=seed)
        flat = replace(some, raw_m=some.raw_m - synthetic.bias_m(lifted(some)), time_ns=20 * some.time_ns)
        known = calib.fit(flat, loss="l2").calibration
        tags = list(known.uncertainty.tags)
        centre = np.eye(len(tags)) - 1 / len(tags)
        error = centre @ [known.delays_ns[tag] - synthetic.DELAYS_NS[tag] for tag in tags]
        scores.append(error / np.sqrt(np.diag(centre @ np.array(known.uncertainty.delays_ns2) @ centre)))
    # Twelve fits with three differences of delays each know a standard deviation to 12 %; persistence that is looked
    # for, and not there, widens intervals of so few ranges by a fifth.
    assert 0.55 < np.sqrt(np.mean(np.square(scores))) < 1.25


def test_times_in_microseconds_for_nanoseconds_do_not_narrow_intervals():
    some = synthetic.ranges(n=600)
    sound, hasty = (calib.fit(replace(some, time_ns=some.time_ns // factor)) for factor in (1, 1000))
    # Thirty blocks know a variance to a quarter; one block, as three milliseconds were, left a third of the width.
    widths = [np.mean(list(found.calibration.delays_std_ns.values())) for found in (sound, hasty)]
    assert widths[1] > 0.75 * widths[0]
    assert [said for said in hasty.warnings if "s of data" in said]


def lifted(ranges):
    return np.mean([10 ** ((power + 82) / 10) for power in (ranges.fpp1_dbm, ranges.fpp2_dbm)], axis=0)
