"""Calibrations in other forms, and MILUV's both ways."""

import json
from dataclasses import replace

import numpy as np
import pytest

from calib.calibration.formats import FORMATS, read_miluv, registers
from calib.calibration.model import Calibration
from calib.errors import BadInputError
from calib.estimation.fitting import fit
from tests.calib.synthetic import DELAYS_NS, ranges
from tests.shared_data import shared
from uwblink.ticks import TICK_S


@pytest.fixture(scope="module")
def fitted():
    return fit(ranges()).calibration


def test_registers_undo_the_delay(fitted):
    """A board with the new registers prints stamps as if its delay were zero, to the rounding of a tick."""
    known = replace(fitted, delays_ns=DELAYS_NS)
    for tag, (tx, rx) in registers(known).items():
        d = DELAYS_NS[tag] * 1e-9 / TICK_S
        # Printed transmit stamps are raw + TX, receive stamps raw - RX; true ones less 0.44 d and plus 0.56 d.
        assert (tx - 16436) + 0.44 * d == pytest.approx(0, abs=0.5)
        assert -(rx - 16436) - 0.56 * d == pytest.approx(0, abs=0.5)
        assert (tx - 16436) + (rx - 16436) == pytest.approx(-d, abs=1)


def test_every_form_holds_the_delays(fitted):
    for name, write in FORMATS.items():
        text = write(fitted)
        assert text.endswith("\n")
        for tag in fitted.delays_ns:
            assert str(tag) in text, name
    assert json.loads(FORMATS["json"](fitted))["delays_ns"]["1"] == fitted.delays_ns[1]
    lines = FORMATS["csv"](fitted).splitlines()
    assert float(lines[1].split(",")[1]) == fitted.delays_ns[1]


def test_miluv_is_read_and_given_back_unchanged():
    path = shared("miluv_published_calibration.json")
    found = read_miluv(path)
    assert json.loads(FORMATS["miluv"](found)) == json.loads(path.read_text())
    assert found.delays_ns[5] == pytest.approx(-0.7376667)
    assert found.bias_curve(np.array([0.5]))[0] == pytest.approx(0.081, abs=0.002)
    r = replace(ranges(500), initiator=np.full(500, 10), target=np.full(500, 20))
    assert np.isfinite(found.apply(r).corrected_m).all()


@pytest.mark.parametrize("text", ["", "[]", '{"delays_ns": 3}', '{"delays_ns": {"a": 1}}'])
def test_what_is_no_miluv_calibration(tmp_path, text):
    (tmp_path / "m.json").write_text(text)
    with pytest.raises(BadInputError, match=r"m\.json: not a MILUV calibration"):
        read_miluv(tmp_path / "m.json")


@pytest.mark.parametrize("form", ["miluv", "ros-yaml"])
def test_a_form_with_one_curve_does_not_take_groups(form):
    grouped = fit(ranges(2000), groups={"a": (1, 2), "b": (3, 7)}).calibration
    with pytest.raises(BadInputError, match="export it as json"):
        FORMATS[form](grouped)
    assert Calibration.from_json(FORMATS["json"](grouped)) == grouped
