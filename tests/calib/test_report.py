"""The report: one file that needs nothing else, and shows what it must."""

import re
from dataclasses import replace

import pytest

from calib.fit import fit
from calib.report import render
from tests.calib.synthetic import DELAYS_NS, ranges


@pytest.fixture(scope="module")
def page():
    planted = {"delays_ns": {str(t): d for t, d in DELAYS_NS.items()}, "bias_curve": None}
    r = replace(ranges(2000), planted=planted, source="<script>alert(1)</script>.uwb")
    return render([r], fit(r).calibration)


def test_it_is_self_contained(page):
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page)
    assert "@import" not in page
    assert "url(" not in page


def test_text_from_files_is_escaped(page):
    assert "<script" not in page
    assert "&lt;script&gt;" in page


def test_it_shows_planted_beside_fitted_and_all_figures(page):
    assert "planted (ns)" in page
    for delay in DELAYS_NS.values():
        assert f"{delay:+.4f}" in page
    assert page.count("<figure>") == 4
    assert page.count("alt='") == 4


def test_without_planted_truth_there_is_no_such_column():
    r = ranges(2000)
    assert "planted (ns)" not in render([r], fit(r).calibration)
