"""Extensions of the estimator by a contributor: an unknown, a part and a kind of row."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from benchmarks.worlds import CLEAN, make
from tests import pages

PER_KELVIN_M = 0.004


EXAMPLE = next(b.code for b in pages.blocks(pages.ROOT / "CONTRIBUTING.md") if "class DataSheet" in b.code)


def temperature_at(time_ns):
    return 10 * np.sin(time_ns * 2e-9)


@cache
def climbed(slope, slope_std):
    """Run the example of CONTRIBUTING.md with a data sheet and return the slope and its deviation."""
    cold = make(CLEAN["short, 30 s"], 12_001).ranges
    warm = replace(cold, raw_m=cold.raw_m + PER_KELVIN_M * temperature_at(cold.time_ns))
    names: dict[str, Any] = {"__name__": "example", "ranges": warm, "temperature_at": temperature_at}
    names |= {"slope": slope, "slope_std": slope_std}
    exec(EXAMPLE, names)  # noqa: S102 - the page is our own
    found, at = names["found"], names["layout"].where["warmth"].start
    assert found.success
    return found.of("warmth")[0], float(np.sqrt(found.covariance[at, at]))


def test_a_new_unknown_needs_one_unknown_and_one_part():
    value, std = climbed(0.0, 1e6)
    assert std < 0.0003
    assert value == pytest.approx(PER_KELVIN_M, abs=4 * std)


def test_a_new_kind_of_row_needs_one_class():
    alone, std = climbed(0.0, 1e6)
    value, both = climbed(0.003, std)
    # Sheet and ranges have equal weight: the result is halfway, and its deviation is smaller by the root of two.
    assert value == pytest.approx((alone + 0.003) / 2, abs=0.2 * std)
    assert both == pytest.approx(std / np.sqrt(2), rel=0.1)


def test_columns_that_differ_within_a_key_are_refused():
    # An offset of the second half of a recording by columns: all ranges of a pair have one key.
    halves = EXAMPLE.replace(
        "np.zeros((len(kelvin), 1), np.int64)", "(np.arange(len(kelvin)) * 2 // len(kelvin))[:, None]"
    )
    halves = halves.replace('("m/K",)', '("first", "second")').replace("np.zeros(1)", "np.zeros(2)")
    warm = make(CLEAN["short, 30 s"], 12_001).ranges
    names: dict[str, Any] = {"__name__": "example", "ranges": warm, "temperature_at": temperature_at}
    with pytest.raises(ValueError, match="warmth: columns differ"):
        exec(halves, names | {"slope": 0.0, "slope_std": 1.0})  # noqa: S102 - the page is our own
