"""Fits whose columns lie in files, worked on some rows at a time, are those of columns in memory."""

from pathlib import Path

import numpy as np
import pytest

import calib
from calib import long_columns
from calib.data.samples import sample_flight
from calib.estimation import mixture_slopes, pair_mixture

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


def in_files(monkeypatch, rows):
    monkeypatch.setattr(long_columns, "MANY", 50)
    monkeypatch.setattr(long_columns, "ROWS_AT_ONCE", rows)
    for module in ("scores", "mixture_slopes"):
        monkeypatch.setattr(f"calib.estimation.{module}.ROWS_AT_ONCE", rows)
    for module in ("design", "building"):
        monkeypatch.setattr(f"calib.estimation.{module}.ROWS_AT_ONCE", max(rows // 4, 7))
    for module in ("design", "building", "scores"):
        monkeypatch.setattr(f"calib.estimation.{module}.PIECES_AT_ONCE", 2)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_a_fit_of_columns_in_files_is_that_of_columns_in_memory(monkeypatch, settings):
    flight = sample_flight(ROWS, seed=4)
    plain = calib.fit(flight, **settings)
    seed = sum(map(len, map(str, settings)))
    in_files(monkeypatch, int(np.random.default_rng(seed).integers(20, 400)))
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


def mapped():
    """Return bytes of columns in files, and how many of them are in the memory of this process."""
    size, resident, ours = 0, 0, False
    for line in Path("/proc/self/smaps").read_text().splitlines():
        name, _, rest = line.partition(":")
        if name in {"Size", "Rss"} and ours:
            count = 1024 * int(rest.split()[0])
            size, resident = size + count * (name == "Size"), resident + count * (name == "Rss")
        elif "-" in name.split(" ")[0] and " " in name:
            ours = " rw-s " in line and line.endswith("(deleted)")
    return size, resident


@pytest.mark.skipif(not Path("/proc/self/smaps").exists(), reason="what is in memory is told by Linux alone")
def test_columns_in_files_are_let_go_of_while_a_fit_goes_on(monkeypatch):
    flight = sample_flight(20_000, seed=4)
    in_files(monkeypatch, 2000)
    seen = []
    sums = mixture_slopes.sums_at

    def watched(*given, **settings):
        seen.append(mapped())
        return sums(*given, **settings)

    monkeypatch.setattr(pair_mixture, "sums_at", watched)
    assert calib.fit(flight, loss="mixture").success
    size, resident = seen[-1]
    assert size > 20_000 * 100
    assert resident < 0.5 * size
