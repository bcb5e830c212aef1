"""Fits that are worked on some rows at a time are those of all rows at once."""

import numpy as np
import pytest

import calib
from calib import long_columns
from calib.data.samples import sample_flight

ROWS = 700
SAME = 1e-8
"""Sums in another order end in other last digits, and with them where a search comes to rest, in ns and metres."""

SETTINGS = [
    {},
    {"loss": "cauchy"},
    {"loss": "l2", "fixed_ns": {1: 0.1}},
    {"sequential": True},
    {"constants": "pair"},
    {"delays_only": True},
    {"groups": {"a": (1,), "b": (2, 3)}},
]


def in_blocks(monkeypatch, rows):
    monkeypatch.setattr(long_columns, "ROWS_AT_ONCE", rows)
    for module in ("scores", "mixture_slopes"):
        monkeypatch.setattr(f"calib.estimation.{module}.ROWS_AT_ONCE", rows)
    for module in ("design", "building"):
        monkeypatch.setattr(f"calib.estimation.{module}.ROWS_AT_ONCE", max(rows // 4, 7))
    for module in ("design", "building", "scores"):
        monkeypatch.setattr(f"calib.estimation.{module}.PIECES_AT_ONCE", 2)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_a_fit_of_columns_in_blocks_is_that_of_columns_in_memory(monkeypatch, settings):
    flight = sample_flight(ROWS, seed=4)
    plain = calib.fit(flight, **settings)
    seed = sum(map(len, map(str, settings)))
    in_blocks(monkeypatch, int(np.random.default_rng(seed).integers(20, 400)))
    found = calib.fit(flight, **settings)
    one, other = plain.calibration, found.calibration
    assert found.warnings == plain.warnings
    for tag, delay in one.delays_ns.items():
        assert other.delays_ns[tag] == pytest.approx(delay, abs=SAME)
        assert other.delays_std_ns[tag] == pytest.approx(one.delays_std_ns[tag], abs=SAME)
    for name in ("bias_curve", "sigma_curve"):
        ours, theirs = (np.array(getattr(c, name).coefficients) for c in (other, one))
        np.testing.assert_allclose(ours, theirs, atol=3 * SAME)
    for pair, offset in one.pair_offsets.items():
        assert other.pair_offsets[pair].offset_m == pytest.approx(offset.offset_m, abs=SAME)
    np.testing.assert_allclose(found.residuals_m, plain.residuals_m, atol=3 * SAME)
    np.testing.assert_array_equal(found.inliers, plain.inliers)
