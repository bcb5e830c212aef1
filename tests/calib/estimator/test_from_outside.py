"""Extensions of the estimator by a contributor: an unknown, a part and a kind of row."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.worlds import CLEAN, make
from tests import pages

PER_KELVIN_M = 0.004


EXAMPLE = next(b.code for b in pages.blocks(pages.ROOT / "CONTRIBUTING.md") if "class DataSheet" in b.code)


@pytest.fixture(scope="module")
def climbed():
    """Return a function that runs the example of CONTRIBUTING.md with a data sheet and returns the slope and its
    deviation.
    """
    cold = make(CLEAN["short, 30 s"], 12_001).ranges

    def temperature_at(time_ns):
        return 10 * np.sin(time_ns * 2e-9)

    warm = replace(cold, raw_m=cold.raw_m + PER_KELVIN_M * temperature_at(cold.time_ns))

    def climb(slope, slope_std):
        names: dict[str, Any] = {"__name__": "example", "ranges": warm, "temperature_at": temperature_at}
        names |= {"slope": slope, "slope_std": slope_std}
        exec(EXAMPLE, names)  # noqa: S102 - the page is our own
        found, at = names["found"], names["layout"].where["warmth"].start
        assert found.success
        return found.of("warmth")[0], float(np.sqrt(found.covariance[at, at]))

    return climb


def test_a_new_unknown_needs_one_unknown_and_one_part(climbed):
    value, std = climbed(0.0, 1e6)
    assert std < 0.0003
    assert value == pytest.approx(PER_KELVIN_M, abs=4 * std)


def test_a_new_kind_of_row_needs_one_class(climbed):
    alone, std = climbed(0.0, 1e6)
    value, both = climbed(0.003, std)
    # Sheet and ranges have equal weight: the result is halfway, and its deviation is smaller by the root of two.
    assert value == pytest.approx((alone + 0.003) / 2, abs=0.2 * std)
    assert both == pytest.approx(std / np.sqrt(2), rel=0.1)
