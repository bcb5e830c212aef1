"""What a fit returns: it prints on a screen, plots itself and saves."""

from dataclasses import replace

import matplotlib
import numpy as np
import pytest

import calib
from tests.calib.synthetic import DELAYS_NS, ranges

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def result():
    return replace(calib.fit(ranges(2000)), warnings=["<b>beware</b> of the dog"])


def test_it_prints_on_a_screen(result):
    text = repr(result)
    lines = text.splitlines()
    assert len(lines) < 20
    assert max(map(len, lines)) < 120
    for tag, delay in result.calibration.delays_ns.items():
        (line,) = [line for line in lines if line.split()[:1] == [str(tag)]]
        assert f"{delay:+.4f}" in line
        assert f"± {1.959964 * result.calibration.delays_std_ns[tag]:.4f}" in line
    assert "2000 ranges of synthetic: converged after" in lines[0]
    assert lines[-1] == "warning: <b>beware</b> of the dog"
    assert repr(result.calibration) in text


def test_a_calibration_prints_as_its_table(result):
    known = result.calibration
    assert len(repr(known)) < 1500
    assert "undetermined" in repr(replace(known, delays_std_ns=dict.fromkeys(DELAYS_NS, np.inf)))
    assert "pinned" in repr(replace(known, delays_std_ns=dict.fromkeys(DELAYS_NS, 0.0)))
    many = replace(known, delays_ns=dict.fromkeys(range(500), 0.1))
    assert "460 more" in repr(many)
    assert len(repr(many).splitlines()) < 60
    low, high = known.bias_curve.range
    shown = np.linspace(low, high, 6)
    assert f"{100 * known.bias_curve(shown)[0]:+.1f}" in repr(known)


def test_groups_have_a_row_each():
    groups = {"round": (1, 2), "flat": (3, 7)}
    text = repr(calib.fit(ranges(2000), groups=groups).calibration)
    assert "bias (cm) round" in text
    assert "sigma (cm) flat" in text


def test_html_is_escaped(result):
    page = result._repr_html_()
    assert "<b>beware" not in page
    assert "&lt;b&gt;beware" in page
    assert page.count("<tr>") == page.count("</tr>") == 1 + len(DELAYS_NS) + 3


def test_it_draws_into_axes(result):
    from matplotlib import pyplot

    for draw in (result.plot_bias, result.plot_sigma, result.plot_residuals, result.plot_delays):
        axes = pyplot.figure().subplots()
        assert draw(axes) is axes
        assert axes.get_xlabel()
        assert axes.get_legend()
    own = result.plot_delays()
    assert own.figure in [pyplot.figure(number) for number in pyplot.get_fignums()]
    pyplot.close("all")
