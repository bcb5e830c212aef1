"""The calibration file, and what applying it does."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BSpline

from calib.calibration.error_model import PairErrors
from calib.calibration.model import Calibration, TagGroup, load_calibration
from calib.errors import BadInputError
from calib.fitting.fitting import fit
from tests.calib.synthetic import ranges
from uwblink.ticks import SPEED_OF_LIGHT


@pytest.fixture(scope="module")
def fitted():
    return fit(ranges()).calibration


@pytest.mark.parametrize(("changes", "version"), [({}, 1), ({"power_at": "reception"}, 3)])
def test_json_both_ways_without_loss(fitted, tmp_path, changes, version):
    known = replace(fitted, **changes)
    known.save(tmp_path / "c.json")
    again = load_calibration(tmp_path / "c.json")
    assert again == known
    assert again.to_json() == known.to_json()
    assert json.loads(known.to_json())["schema_version"] == version


def lifted(dbm):
    return 10 ** ((dbm + 82) / 10)


def powers_at(lift, power_at, first, second):
    """Return the lifted powers at which the bias is taken."""
    if power_at == "reception":
        return [lifted(first), lifted(second)]
    return [lifted((first + second) / 2) if lift == "lift-of-mean" else (lifted(first) + lifted(second)) / 2]


@pytest.mark.parametrize(
    ("lift", "power_at"),
    [("mean-of-lifted", "exchange"), ("lift-of-mean", "exchange"), ("mean-of-lifted", "reception")],
)
@pytest.mark.parametrize("grouped", [False, True])
def test_a_range_is_corrected_as_the_formulas_say(fitted, lift, power_at, grouped):
    """Half of each delay and the mean curve of both tags, at the powers that there are; one at a time or together."""
    lower = replace(fitted.bias_curve, coefficients=tuple(c - 0.1 for c in fitted.bias_curve.coefficients))
    noisy = replace(fitted.sigma_curve, coefficients=tuple(2 * c for c in fitted.sigma_curve.coefficients))
    own = {"a": TagGroup((1, 2), fitted.bias_curve, fitted.sigma_curve), "b": TagGroup((3, 7), lower, noisy)}
    known = replace(fitted, lift=lift, power_at=power_at, groups=own if grouped else {})
    powers = {(-85.0, -92.0): (-85.0, -92.0), (0.0, -90.0): (-90.0, -90.0), (-88.0, np.nan): (-88.0, -88.0)}
    for (printed, both), (i, j) in zip(powers.items(), [(1, 2), (3, 1), (7, 3)], strict=True):
        found = known.correct(3.0, *printed, i, j, weights=(0.5, 0.50001))
        at = powers_at(lift, power_at, *both)
        away = 0.1 * sum(tag > 2 for tag in (i, j)) / 2 if grouped else 0.0
        delays = SPEED_OF_LIGHT * 1e-9 * (0.5 * known.delays_ns[i] + 0.50001 * known.delays_ns[j])
        curve = BSpline(fitted.bias_curve.knots, fitted.bias_curve.coefficients, 3)
        bias = np.mean([curve(np.clip(one, *fitted.bias_curve.range)) for one in at]) - away
        assert found.range_m == pytest.approx(3.0 + delays - bias, abs=1e-9)
        assert type(found.range_m) is float
        at_both = replace(known, power_at="exchange").correct(3.0, *both, i, j)
        times = 1 + sum(tag > 2 for tag in (i, j)) / 2 if grouped else 1
        (middle,) = powers_at(lift, "exchange", *both)
        plain = fitted.sigma_curve(np.clip(middle, *fitted.sigma_curve.range))
        assert found.sigma_m == at_both.sigma_m == pytest.approx(times * plain)
        together = known.correct(np.array([3.0, 4.0]), *printed, i, [j, j], weights=(0.5, 0.50001))
        np.testing.assert_array_equal([column[0] for column in together], found)
        assert together.range_m[1] == pytest.approx(1 + found.range_m)
    blind = known.correct(3.0, 0.0, np.nan, 1, 2)
    assert blind.range_m == pytest.approx(3.0 + SPEED_OF_LIGHT * 5e-10 * (known.delays_ns[1] + known.delays_ns[2]))
    assert np.isnan([blind.sigma_m, blind.sigma_total_m, blind.tail_share]).all()
    far = known.correct(3.0, -60.0, -60.0, 1, 2)
    assert far.clamped
    assert far.sigma_total_m > known.correct(3.0, -79.0, -79.0, 1, 2).sigma_total_m


@pytest.mark.parametrize("name", ["1-2", "2-1"])
def test_factors_of_a_pair_hold_in_both_directions(fitted, name):
    errors = replace(fitted.errors, pairs={name: PairErrors(1.0, 3.0, 1.0)})
    known = Calibration.from_json(replace(fitted, errors=errors).to_json())
    there, back, other = (known.correct(3.0, -85.0, -86.0, *ends).tail_share for ends in ((1, 2), (2, 1), (1, 3)))
    assert there == back
    assert there / (1 - there) == pytest.approx(3 * other / (1 - other))


def test_a_tag_in_no_group_is_named(fitted):
    with pytest.raises(BadInputError, match="tag 7 is in none"):
        replace(fitted, groups={"a": TagGroup((1, 2, 3), fitted.bias_curve, fitted.sigma_curve)}).apply(ranges(10))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"degree": 3', '"degree": 9'),
        ('"loss": "mixture"', '"loss": 5'),
        ('"delays_ns": {', '"delays_ns": {"x": 1, '),
        ('"alpha_dbm": -82.0', '"alpha_dbm": "low"'),
        ('"alpha_dbm": -82.0', '"alpha_dbm": -82.0, "power_at": "somewhere"'),
        ('"speed_of_light": 299702547.0', '"speed_of_light": NaN'),
        ('"scale_ns": ', '"scale_ns": 1e300, "was": '),
        ('"tags": [', '"tags": [9, '),
        ('"provenance": {', '"provenance": {"added": 1e400, '),
        ('"provenance": {', '"provenance": {"added": -Infinity, '),
    ],
)
def test_a_damaged_file_is_one_clear_error(fitted, old, new):
    text = fitted.to_json()
    assert old in text
    with pytest.raises(BadInputError, match=r"^here"):
        Calibration.from_json(text.replace(old, new), "here")
