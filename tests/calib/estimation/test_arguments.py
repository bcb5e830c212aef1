"""What a fit's parameters may be: every mistake names the parameter, before anything is computed."""

import math
from typing import Any

import numpy as np
import pytest

from calib.errors import BadInputError
from calib.fitting.fitting import add_tag, fit
from tests.calib.synthetic import ranges


@pytest.mark.parametrize(
    ("parameter", "value"),
    [
        ("loss", "arctan"),
        ("reference_power_dbm", math.nan),
        ("scale_ns", -1),
        ("scale_ns", 0.0),
        ("scale_ns", math.nan),
        ("scale_ns", "auto"),
        ("lift", "up"),
        ("constants", "board"),
        ("alpha_dbm", math.inf),
        ("fixed_ns", {1: math.nan}),
        ("fixed_ns", {1.5: 0.1}),
        ("fixed_ns", {99: 0.1}),
        ("groups", {"a": [1, 2], "b": [2, 3, 7]}),
        ("groups", {"a": "12"}),
        ("groups", {"a": []}),
        ("groups", {"a": [1, 2]}),
        ("groups", {"a": [1, 2, 3, 7], "b": [8]}),
    ],
)
def test_a_mistake_names_its_parameter(parameter, value):
    with pytest.raises(BadInputError) as caught:
        fit(ranges(300), **{parameter: value})
    assert caught.value.parameter == parameter
    assert str(caught.value).startswith(f"`{parameter}`: ")
    assert "--" not in str(caught.value)


def test_the_mixture_is_not_fitted_sequentially():
    with pytest.raises(BadInputError) as caught:
        fit(ranges(300), sequential=True, loss="mixture")
    assert caught.value.parameter == "sequential"


def test_numpy_numbers_are_numbers():
    r = ranges(600)
    plain = fit(r, scale_ns=0.1, fixed_ns={1: -0.36}, groups={"a": (1, 2), "b": (3, 7)})
    numbers: dict[str, Any] = {
        "scale_ns": np.float64(0.1),
        "fixed_ns": {np.int64(1): np.float64(-0.36)},
        "groups": {"a": np.array([1, 2]), "b": np.array([3, 7])},
    }
    numpy = fit(r, **numbers)
    assert numpy.calibration.to_json() == plain.calibration.to_json()


@pytest.mark.parametrize(("tag", "loss", "parameter"), [(-1, "l2", "tag"), (7, "arctan", "loss"), (1, "l2", "tag")])
def test_a_new_tag_is_checked(tag, loss, parameter):
    r = ranges(1200)
    known = fit(r[(r.initiator != 7) & (r.target != 7)]).calibration
    with pytest.raises(BadInputError) as caught:
        add_tag(r, known, tag, loss)
    assert caught.value.parameter == parameter
