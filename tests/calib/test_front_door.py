"""The front door of calib: its names, what importing it costs, and its examples."""

import doctest
from typing import Any

import pytest

import calib
from calib.estimator.losses import LOSSES
from calib.report.sections import SECTIONS
from tests import pages
from uwblink.pages import figures


def test_the_names_are_sorted_and_all_there():
    assert calib.__all__ == sorted(calib.__all__)
    for name in calib.__all__:
        assert getattr(calib, name).__name__ == name
    assert set(calib.__all__) <= set(dir(calib))


@pytest.mark.parametrize("name", [name for name in calib.__all__ if not name.endswith("Error")])
def test_the_examples_run(name, monkeypatch):
    monkeypatch.setattr(figures, "drawn", pages.outline)
    losses, sections = set(LOSSES), dict(SECTIONS)
    runner = doctest.DocTestRunner()
    examples = [test for test in doctest.DocTestFinder().find(getattr(calib, name), name, globs={}) if test.examples]
    assert examples, f"{name} has no example"
    for one in examples:
        runner.run(one)
    assert runner.summarize(verbose=False).failed == 0
    # An example that adds something takes it out again: other tests must not find it.
    assert (set(LOSSES), dict(SECTIONS)) == (losses, sections)


def test_what_is_handed_out_prints_on_a_screen():
    flight = calib.sample_flight()
    known = calib.fit(flight).calibration
    ranges = calib.load_ranges(flight)
    columns = known.correct(ranges.raw_m, ranges.fpp1_dbm, ranges.fpp2_dbm, ranges.initiator, ranges.target)
    for thing in (ranges, known.apply(ranges), columns, known, *calib.localize(flight, known)):
        text = repr(thing)
        assert len(text) < 2000, type(thing)
        assert max(map(len, text.splitlines())) <= 120, type(thing)


def test_what_is_no_calibration_is_refused_by_its_parameter(tmp_path):
    flight = calib.sample_flight()
    result = calib.fit(flight)
    calls: dict[str, Any] = {
        "evaluate": lambda wrong: calib.evaluate(flight, wrong),
        "localize": lambda wrong: calib.localize(flight, wrong),
        "export": lambda wrong: calib.export(wrong, "csv"),
        "compare": lambda wrong: calib.compare(result.calibration, wrong),
        "apply": lambda wrong: calib.apply(tmp_path / "f.uwb", wrong, tmp_path / "g.uwb"),
        "write_report": lambda wrong: calib.write_report(tmp_path / "r.html", flight, wrong),
    }
    no_calibrations: tuple[Any, ...] = (None, 3, {})
    for wrong in no_calibrations:
        for name, call in calls.items():
            with pytest.raises(calib.BadInputError, match="expected a Calibration") as caught:
                call(wrong)
            assert caught.value.parameter == ("second" if name == "compare" else "calibration")
    assert list(tmp_path.iterdir()) == []
    # A result and the path of a calibration are as good as the calibration.
    result.save(tmp_path / "c.json")
    for given in (result, tmp_path / "c.json", str(tmp_path / "c.json")):
        assert calib.evaluate(flight, given).to_dict() == calib.evaluate(flight, result.calibration).to_dict()
        assert calib.compare(given, result).same
        assert calib.export(given, "csv") == calib.export(result.calibration, "csv")
    assert result.correct(3.0, -85.0, -86.0, 1, 2) == result.calibration.correct(3.0, -85.0, -86.0, 1, 2)
