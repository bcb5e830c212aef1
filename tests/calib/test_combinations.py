"""Combinations of settings of a fit, over recordings of different kinds: each gives a calibration or a reason."""

from contextlib import suppress
from functools import cache
from itertools import combinations
from typing import Any

import numpy as np
import pytest

import calib
import uwbsim
from benchmarks.directions import Recipe, flight

FLIGHTS = {
    "three robots": ["icra2023/train"],
    "two flights": ["icra2023/train", "icra2023/test1"],
    "anchors that do not range": ["anchors_and_tag/bipartite"],
    "anchors beside another flight": ["anchors_and_tag/anchors_and_tag", "icra2023/train"],
    "boards that warm up": ["warm_up/warm_up"],
    "without noise": ["noiseless"],
    "patterns": [],
}
SETTINGS: dict[str, tuple[Any, ...]] = {
    "loss": ("mixture", "cauchy", "huber"),
    "lift": ("mean-of-lifted", "lift-of-mean"),
    "constants": ("pair",),
    "use": ("receptions",),
    "pattern": ("none", "shared", "tag"),
    "temperature": ("none", "shared", "tag"),
    "sequential": (True,),
    "delays_only": (True,),
    "scale_ns": (0.001, 10.0),
    "between_m": (0.0, 0.5),
    "reference_power_dbm": (-120.0, -60.0),
    "hold_out": (0.1, 0.9),
    "fixed_ns": ({1: 0.1}, {1: 0.1, 4: 0.0}, dict.fromkeys((1, 2, 3, 4, 5, 6), 0.0)),
    "groups": ({"some": (1, 2, 3)}, {"some": (1, 2), "others": (4, 5)}),
}
CHANGES = [(name, value) for name, values in SETTINGS.items() for value in values]


@cache
def flown(name):
    found = [uwbsim.simulate(uwbsim.load(one, {"run.duration_s": 15.0})) for one in FLIGHTS[name]]
    return found or [flight(Recipe(seconds=20), 1)[0]]


@cache
def another():
    return calib.fit(flown("three robots")).calibration


@pytest.mark.slow
@pytest.mark.parametrize("name", FLIGHTS)
def test_each_setting_alone_and_pairs_of_settings_are_fitted_or_refused(tmp_path, name):
    # A third of all pairs of settings; each flight has its share of them.
    own = list(combinations(CHANGES, 2))[list(FLIGHTS).index(name) :: 3 * len(FLIGHTS)]
    for number, changes in enumerate([*([one] for one in CHANGES), *own]):
        file = tmp_path / f"{number}.json"
        with suppress(calib.CalibError):
            calib.fit(flown(name), **dict(changes)).save(file)
            known = calib.load_calibration(file)
            overall = calib.evaluate(flown(name), known).overall
            assert np.isfinite([*known.delays_ns.values(), overall.full.median_m]).all(), changes
            calib.compare(known, another())
            calib.export(known, "registers")
