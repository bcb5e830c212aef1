"""Settings of a fit in combination, over recordings of different kinds: each gives a calibration or a reason."""

from contextlib import suppress
from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

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
SETTINGS = {
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
    found = [uwbsim.simulate(uwbsim.load(one, {"run.duration_s": 20.0})) for one in FLIGHTS[name]]
    return found or [flight(Recipe(), 1)[0]]


@pytest.mark.slow
@pytest.mark.parametrize("name", FLIGHTS)
@settings(max_examples=25, derandomize=True, suppress_health_check=list(HealthCheck))
@given(changes=st.lists(st.sampled_from(CHANGES), max_size=3).map(dict))
def test_a_combination_is_fitted_or_refused(tmp_path_factory, name, changes):
    file = tmp_path_factory.mktemp("fit") / "cal.json"
    with suppress(calib.CalibError):
        calib.fit(flown(name), **changes).save(file)
        known = calib.load_calibration(file)
        assert np.isfinite([*known.delays_ns.values(), calib.evaluate(flown(name), known).overall.full.median_m]).all()
        calib.compare(known, calib.fit(flown("three robots")).calibration)
        calib.export(known, "registers")
