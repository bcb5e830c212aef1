"""The front door of calib: its names, what importing it costs, and its examples."""

import doctest
import subprocess
import sys
from typing import Any

import pytest

import calib
from calib.estimator.losses import LOSSES
from calib.report.sections import SECTIONS

SECONDS = 0.25


def test_the_names_are_sorted_and_all_there():
    assert calib.__all__ == sorted(calib.__all__)
    for name in calib.__all__:
        assert getattr(calib, name).__name__ == name
    assert set(calib.__all__) <= set(dir(calib))


def test_importing_it_loads_nothing_heavy():
    code = "import sys, calib; print([m for m in ('numpy', 'scipy', 'duckdb', 'matplotlib') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout.strip() == "[]"


def test_importing_it_is_quick():
    code = "import time; t = time.perf_counter(); import calib; print(time.perf_counter() - t)"
    spent = [float(subprocess.run([sys.executable, "-c", code], capture_output=True).stdout) for _ in range(5)]
    assert min(spent) < SECONDS


@pytest.mark.parametrize("name", [name for name in calib.__all__ if not name.endswith("Error")])
def test_the_examples_run(name):
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


@pytest.mark.parametrize("wrong", [None, "calibration.json", {}])
def test_what_is_no_calibration_is_refused_by_its_parameter(wrong, tmp_path):
    flight = calib.sample_flight()
    known = calib.fit(flight).calibration
    calls = {
        "evaluate": lambda: calib.evaluate(flight, wrong),
        "localize": lambda: calib.localize(flight, wrong),
        "export": lambda: calib.export(wrong, "csv"),
        "compare": lambda: calib.compare(known, wrong),
        "apply": lambda: calib.apply(tmp_path / "f.uwb", wrong, tmp_path / "g.uwb"),
        "write_report": lambda: calib.write_report(tmp_path / "r.html", flight, wrong),
    }
    for name, call in calls.items():
        with pytest.raises(calib.BadInputError, match="expected a Calibration") as caught:
            call()
        assert caught.value.parameter in ("calibration", "second"), name
    assert list(tmp_path.iterdir()) == []


def test_a_fit_given_for_its_calibration_is_told_so():
    flight = calib.sample_flight()
    result: Any = calib.fit(flight)
    with pytest.raises(calib.BadInputError) as caught:
        calib.evaluate(flight, result)
    assert str(caught.value) == "`calibration`: found FitResult, expected a Calibration; give its `.calibration`"
