"""Tails of distributions against SciPy's, and against what holds for every distribution."""

import numpy as np
import pytest
from scipy import special

from calib.tails import erfcx, log_normal_below, normal_below, students_quantile

WIDE = np.concatenate([np.linspace(-21, 30, 5001), np.geomspace(1e-12, 1e8, 500), -np.geomspace(1e-12, 1, 100), [0.0]])


def test_the_scaled_complementary_error_function_is_exact():
    np.testing.assert_allclose(erfcx(WIDE), special.erfcx(WIDE), rtol=5e-15)
    assert erfcx(np.array([np.nan]))[0] != 0
    assert erfcx(np.zeros(0)).shape == (0,)


def test_it_is_the_same_to_the_last_bit_of_few_values_and_of_many():
    many = erfcx(WIDE)
    for k in range(0, len(WIDE) - 3, 50):
        assert erfcx(WIDE[k : k + 3]).tolist() == many[k : k + 3].tolist()
    assert erfcx(WIDE[:6].reshape(2, 3)).tolist() == many[:6].reshape(2, 3).tolist()


def test_normal_shares_are_exact_in_both_tails():
    x = np.linspace(-37, 37, 2001)
    np.testing.assert_allclose(normal_below(x), special.ndtr(x), rtol=1e-12)
    np.testing.assert_allclose(log_normal_below(x), special.log_ndtr(x), rtol=1e-12, atol=1e-300)
    np.testing.assert_allclose(log_normal_below(np.array([-1e4])), special.log_ndtr(np.array([-1e4])), rtol=1e-14)
    assert normal_below(np.array([-np.inf, np.inf, -1e300])).tolist() == [0, 1, 0]


@pytest.mark.parametrize("freedom", [2.0, 2.7, 3.0, 8.4, 31.0, 977.3, 41_000.0])
def test_students_quantiles_are_exact(freedom):
    for share in (0.5, 0.6, 0.975, 1 - 0.005 / 80, 1 - 1e-9):
        assert students_quantile(freedom, share) == pytest.approx(special.stdtrit(freedom, share), rel=1e-9, abs=1e-12)
