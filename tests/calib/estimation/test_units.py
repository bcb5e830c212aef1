"""Lengths and powers in other units than metres and dBm: nothing is fitted to them, and the unit is named."""

from dataclasses import replace

import numpy as np
import pytest

import calib
from tests.calib import synthetic
from tests.processes import run
from uwblink import Contents


def hardly_moving(seed=1):
    """Return ranges of bodies that move by a decimetre or two, so that no slope over distance tells a unit."""
    some = synthetic.ranges(n=900, seed=seed)
    truth = 2.5 + 0.2 * np.random.default_rng(seed).random(len(some))
    return replace(some, raw_m=some.raw_m - some.truth_m + truth, truth_m=truth)


@pytest.mark.parametrize(
    ("column", "times", "unit", "more"),
    [
        ("truth_m", 1000, "millimetres", {}),
        ("truth_m", 100, "centimetres", {"loss": "l2"}),
        ("raw_m", 1000, "millimetres", {"delays_only": True}),
        ("raw_m", 1000, "millimetres", {"sequential": True}),
    ],
)
def test_another_unit_is_refused_and_named(column, times, unit, more):
    some = hardly_moving()
    calib.fit(some, **more)
    with pytest.raises(calib.UnanswerableError, match=unit) as refused:
        calib.fit(replace(some, **{column: getattr(some, column) * times}), **more)
    assert ("true distances look" in str(refused.value)) == (column == "truth_m")


def test_boards_that_were_programmed_with_no_delay_are_fitted():
    some = synthetic.ranges(n=900)
    found = calib.fit(replace(some, raw_m=some.raw_m + 514e-9 * 299_702_547.0))
    assert all(-516 < delay < -512 for delay in found.calibration.delays_ns.values())
    assert [said for said in found.warnings if "antenna delays" in said]


@pytest.mark.parametrize("change", ["poses", "powers"])
def test_the_command_writes_nothing_and_ends_with_1(tmp_path, change):
    flight = calib.sample_flight(300)
    poses, exchanges = flight.poses, flight.exchanges
    if change == "poses":
        poses = replace(poses, position_m=poses.position_m * 1000)
    else:
        exchanges = replace(exchanges, fpp1_dbm=-exchanges.fpp1_dbm, fpp2_dbm=-exchanges.fpp2_dbm)
    Contents(exchanges=exchanges, poses=poses, tags=flight.tags).save(tmp_path / "flight.uwb")
    done = run("calib", "fit", tmp_path / "flight.uwb", "-o", tmp_path / "c.json")
    assert done.returncode == 1
    assert ("millimetres" if change == "poses" else "dBm") in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["flight.uwb"]
