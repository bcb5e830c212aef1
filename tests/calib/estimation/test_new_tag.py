"""A new tag from calibrated ones."""

from dataclasses import replace

import numpy as np
import pytest

from calib.errors import BadInputError, UnanswerableError
from calib.fitting.fitting import add_tag, fit
from tests.calib.synthetic import DELAYS_NS, ranges


@pytest.fixture(scope="module")
def known():
    r = ranges(8000)
    three = r[(r.initiator != 7) & (r.target != 7)]
    return fit(three).calibration


def test_its_delay_is_found_and_nothing_else_moves(known):
    added = add_tag(ranges(3000, seed=5), known, 7).calibration
    assert {t: d for t, d in added.delays_ns.items() if t != 7} == known.delays_ns
    assert added.bias_curve == known.bias_curve
    # The fitted delays of the others share a shift with the curve, and the new one has it, too.
    shift = np.mean([known.delays_ns[t] - DELAYS_NS[t] for t in known.delays_ns])
    assert added.delays_ns[7] - shift == pytest.approx(DELAYS_NS[7], abs=0.05)
    assert 0.002 < added.delays_std_ns[7] < 0.03


def test_one_calibrated_tag_is_enough(known):
    r = ranges(3000, seed=6)
    added = add_tag(r[(r.initiator == 1) & (r.target == 7)], known, 7).calibration
    shift = known.delays_ns[1] - DELAYS_NS[1]
    assert added.delays_ns[7] - shift == pytest.approx(DELAYS_NS[7], abs=0.08)


def test_what_cannot_be_added(known):
    r = ranges(3000)
    with pytest.raises(BadInputError, match="does not range"):
        add_tag(r, known, 42)
    strangers = replace(known, delays_ns={99: 0.0})
    with pytest.raises(UnanswerableError, match="too few"):
        add_tag(r, strangers, 7)
