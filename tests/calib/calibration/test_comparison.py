"""Two calibrations side by side."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from calib.calibration.comparison import compare
from calib.errors import UnanswerableError
from calib.fitting.fitting import fit
from tests.calib.synthetic import ranges
from uwblink.ticks import SPEED_OF_LIGHT


def test_fits_of_the_same_tags_are_the_same_nineteen_times_in_twenty():
    fits = [fit(ranges(3000, seed=seed)).calibration for seed in range(9)]
    found = [compare(a, b) for a, b in itertools.pairwise(fits)]
    # 8 comparisons, 0.4 expected to differ; more than three come by chance less than once in a thousand.
    assert sum(one.same for one in found) >= 5
    # Four delays less a shift: chi-square with 3 degrees of freedom, whose mean over 8 is known to 0.9 or so;
    # intervals allow for small samples and for reflections of unknown shape, and are a little wide for it.
    assert 0.9 < np.mean([one.chi_square for one in found]) < 5.0
    scores = [d / one.std_ns[t] for one in found for t, d in one.difference_ns.items()]
    assert 0.55 < np.std(scores) < 1.3


def test_a_delay_that_moved_is_seen():
    a = fit(ranges(6000)).calibration
    moved = replace(a, delays_ns=a.delays_ns | {3: a.delays_ns[3] + 0.1})
    found = compare(a, moved)
    assert not found.same
    assert max(found.difference_ns, key=lambda t: abs(found.difference_ns[t])) == 3
    assert f"{found.difference_ns[3]:+.4f} ns" in str(found)
    assert "the delays are different" in str(found)


def test_a_shift_of_delays_against_the_curve_is_no_difference():
    a = fit(ranges(6000)).calibration
    shift_m = 0.05
    shift_ns = shift_m / SPEED_OF_LIGHT * 1e9
    curve = replace(a.bias_curve, coefficients=tuple(c + shift_m for c in a.bias_curve.coefficients))
    other = replace(a, delays_ns={t: d + shift_ns for t, d in a.delays_ns.items()}, bias_curve=curve)
    found = compare(a, other)
    assert found.same
    assert found.offset_m == pytest.approx(0, abs=1e-9)
    assert found.curve_rms_m == pytest.approx(0, abs=1e-9)
    assert np.abs(list(found.difference_ns.values())).max() < 1e-9


def test_nothing_in_common_cannot_be_compared():
    a = fit(ranges(2000)).calibration
    with pytest.raises(UnanswerableError, match="0 tags have determined delays in both"):
        compare(a, replace(a, delays_ns={99: 0.0}))
