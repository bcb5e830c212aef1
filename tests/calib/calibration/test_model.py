"""The calibration file, and what applying it does."""

import json

import numpy as np
import pytest

from calib.calibration.model import Calibration, load_calibration, rests_on
from calib.errors import BadInputError
from calib.fitting.fitting import fit
from tests.calib.synthetic import ranges
from uwblink.ticks import SPEED_OF_LIGHT

KNOWN = {"known_s": 9.9, "moving": ["a", "b", "c"], "anchors_given": ["m"], "anchors_sought": [], "attitudes": "imu"}


@pytest.fixture(scope="module")
def fitted():
    return fit(ranges()).calibration


def test_json_both_ways_without_loss(fitted, tmp_path):
    fitted.save(tmp_path / "c.json")
    again = load_calibration(tmp_path / "c.json")
    assert again == fitted
    assert again.to_json() == fitted.to_json()


def test_the_file_has_the_documented_keys(fitted):
    document = json.loads(fitted.to_json())
    assert {
        "schema_version", "delays_ns", "delays_std_ns", "loss", "scale_ns", "lift", "alpha_dbm", "speed_of_light",
        "bias_curve", "sigma_curve", "provenance", "uncertainty",
        "errors",
    } == set(document)  # fmt: skip
    assert set(document["bias_curve"]) == {"knots", "coefficients", "degree", "range"} == set(document["sigma_curve"])
    assert document["loss"] == "mixture"
    assert document["lift"] == "mean-of-lifted"
    assert document["speed_of_light"] == SPEED_OF_LIGHT


def test_apply_adds_half_the_delays_and_takes_off_the_curve(fitted):
    r = ranges(10, seed=9)
    applied = fitted.apply(r)
    for k in range(len(r)):
        d_i, d_j = fitted.delays_ns[int(r.initiator[k])], fitted.delays_ns[int(r.target[k])]
        expected = r.raw_m[k] + SPEED_OF_LIGHT * 1e-9 * (0.5 * d_i + r.weight_target[k] * d_j)
        assert applied.delay_corrected_m[k] == pytest.approx(expected, abs=1e-12)
        lifted = (10 ** ((r.fpp1_dbm[k] + 82) / 10) + 10 ** ((r.fpp2_dbm[k] + 82) / 10)) / 2
        assert applied.corrected_m[k] == pytest.approx(expected - fitted.bias_curve(np.array([lifted]))[0], abs=1e-12)


def test_an_unknown_tag_is_named(fitted):
    r = ranges(10)
    without = Calibration.from_json(fitted.to_json().replace('"7":', '"8":'))
    with pytest.raises(BadInputError, match="tag 7"):
        without.apply(r)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('"degree": 3', '"degree": 9'),
        ('"loss": "mixture"', '"loss": 5'),
        ('"delays_ns": {', '"delays_ns": {"x": 1, '),
        ('"alpha_dbm": -82.0', '"alpha_dbm": "low"'),
        ('"speed_of_light": 299702547.0', '"speed_of_light": NaN'),
        ('"scale_ns": ', '"scale_ns": 1e300, "was": '),
        ('"provenance": {', '"provenance": {"added": 1e400, '),
        ('"provenance": {', '"provenance": {"added": -Infinity, '),
    ],
)
def test_a_damaged_file_is_one_clear_error(fitted, old, new):
    text = fitted.to_json()
    assert old in text
    with pytest.raises(BadInputError, match=r"^here"):
        Calibration.from_json(text.replace(old, new), "here")


@pytest.mark.parametrize(
    ("provenance", "told"),
    [
        (
            {"truth": "ranges", "rests_on": KNOWN, "distance_std_m": 0.0123},
            "ranges alone, of 3 moving bodies, positions known for 9.9 s, 1 anchor at places that were given, "
            "attitudes from imu, distances found to 1.2 cm (standard error)",
        ),
        ({}, ""),
        ({"truth": "ranges", "rests_on": "a lake"}, ""),
        ({"truth": "recorded", "rests_on": KNOWN}, ""),
    ],
)
def test_what_a_fit_without_known_distances_rests_on_is_one_phrase(provenance, told):
    assert rests_on(provenance) == told
