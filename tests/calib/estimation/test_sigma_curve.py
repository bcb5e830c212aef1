"""Curves of groups of tags: from how many ranges on."""

import numpy as np
import pytest

from calib.errors import UnanswerableError
from calib.estimator.range_model import MIN_RANGES_OF_GROUP as FEWEST
from calib.fitting.fitting import fit
from tests.calib.synthetic import ranges


@pytest.mark.parametrize("count", [FEWEST - 1, FEWEST])
def test_a_group_has_a_curve_from_the_fewest_ranges_on(count):
    r = ranges(3000)
    rare = (r.initiator != 7) & (r.target != 7)
    rare[np.flatnonzero(~rare)[:count]] = True
    groups = {"a": (1, 2, 3), "b": (7,)}
    if count < FEWEST:
        with pytest.raises(UnanswerableError, match="group 'b' has too few ranges"):
            fit(r[rare], groups=groups, loss="cauchy")
    else:
        assert set(fit(r[rare], groups=groups, loss="cauchy").calibration.groups) == {"a", "b"}
