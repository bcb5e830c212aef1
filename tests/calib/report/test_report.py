"""The report: one file that needs no other file, with all of its content."""

import hashlib
import json
import re

import numpy as np
import pytest
from matplotlib.image import imread

from calib.cli.judging import spread_tests
from calib.fitting.fitting import fit
from calib.report import Table
from calib.report.results import Results
from calib.report.sections import SECTIONS
from tests import browser, shared_data
from tests.calib.report import page_of_numpy
from tests.calib.synthetic import ranges
from tests.processes import succeed as run
from uwblink import load

TEST = "<script>alert(1)<script>"
"""The name of the test flight, which must not become a part of the page."""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A training flight with passive listeners, a test flight, and the report of both as a page and as JSON."""
    folder = tmp_path_factory.mktemp("campaign")
    for name, seed in (("train", 1), (TEST, 2)):
        words = f"-o {name}.uwb --set run.seed={seed} --set run.duration_s=6 --set tags.0.passive=true"
        run("uwbsim", "run", shared_data.ROOT / "scenarios/icra2023/train.toml", *words.split(), cwd=folder)
    words = f"report train.uwb --tests {TEST}.uwb -o r.html --json"
    (folder / "r.json").write_text(run("calib", *words.split(), cwd=folder).stdout)
    return folder


@pytest.fixture(scope="module")
def page(campaign):
    return (campaign / "r.html").read_text()


def test_the_campaign_has_every_section_in_order(campaign, page):
    sections = re.findall("<h2 id='s[0-9]+'>(.*?)</h2>", page)
    assert sections == [
        "What was recorded", "Are the delays determined?", "Antenna delays", "Bias and standard deviation over power",
        "Before and after", "Outliers", "Localization", "Over time", "Provenance",
    ]  # fmt: skip
    assert "these flights are simulated, so values in metres cannot be compared" in page
    assert page.count("class='many'") == 2, "tables of recordings and by pair and stage are set smaller"
    assert not re.findall(r"(?:src|href)=['\"](?!data:|#)|@import|url\((?!#)", page), "it needs no other file"
    assert not re.findall(r"\b(?:fetch|XMLHttpRequest|WebSocket|import)\b\(", page)
    assert page.count("<script") == 1, "the page's own, and none from a file"
    assert page.count("aria-label='Figure ") == 2 * page.count("<figure>"), "each in two widths, with its caption"
    assert re.search("[Ff]it for use", page[: page.index("<nav")]), "the verdict stands first"
    assert "uwbcal " in page[: page.index("<nav")]
    assert "calib report train.uwb --tests" in page
    for name in ("train.uwb", f"{TEST}.uwb"):
        assert page.count(hashlib.sha256((campaign / name).read_bytes()).hexdigest()) == 1


def test_all_figures_have_paper_size(page):
    drawings = re.findall("<svg.*?</svg>", page, re.DOTALL)
    assert len(drawings) == 2 * page.count("<figure>")
    for drawing in drawings:
        assert drawing.startswith(('<svg viewBox="0 0 252 ', '<svg viewBox="0 0 515.52 ')), "3.5 or 7.16 inches"
        assert drawing.count("<text") > 5, "text as text"
        assert min(map(float, re.findall(r"font(?:-size)?: ([0-9.]+)px", drawing))) == 8.0


def test_the_json_contains_the_results_of_the_page(campaign):
    document = json.loads((campaign / "r.json").read_text())
    assert {"calibration", "warnings", "evaluation", "heard", "findings", "localization"} == set(document)
    assert document["evaluation"]["overall"]["full"]["n"] == 960
    assert document["evaluation"]["planted"]["correction_rms_m"] < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_shows_the_report(campaign, page, tmp_path, width):
    picture = tmp_path / "page.png"
    words = (f"--window-size={width},2400", f"--screenshot={picture}", (campaign / "r.html").as_uri())
    browser.chromium(*words, profile=tmp_path / "profile")
    browser.lies_well(page, width, tmp_path)
    pixels = imread(picture)
    assert pixels.shape[:2] == (2400, width)
    # Text and figures from top to bottom: no band of the page is blank.
    assert all(band.max() > 0.05 for band in np.array_split(pixels[..., :3].std(axis=(1, 2)), 8))


def test_tests_take_several_files():
    told = ["report", "a", "-o", "r", "--tests", "b", "c", "--force", "d"]
    assert spread_tests(told) == ["report", "a", "-o", "r", "--tests", "b", "--tests", "c", "--force", "d"]
    assert spread_tests(["fit", "a", "-o", "c"]) == ["fit", "a", "-o", "c"]


def test_planted_delays_are_shown_beside_fitted_ones(campaign, page):
    header, *rows = page_of_numpy.Tables(page).having("planted, same gauge (ns)")
    given = load(campaign / "train.uwb").meta["planted"]["delays_ns"]
    fitted, known, difference_ps = np.array([[page_of_numpy.number(row[k]) for k in (1, 4, 5)] for row in rows]).T
    planted = np.array([given[row[0]] for row in rows])
    assert len(rows) == 6
    assert known == pytest.approx(planted + np.mean(fitted - planted), abs=2e-4), "moved by what is common to all"
    assert fitted - known == pytest.approx(1e-3 * difference_ps, abs=2e-4)
    assert "by listeners (ns)" in header
    unplanted = Results(calibration=fit(ranges(600)).calibration, tests=[ranges(600)])
    (table,) = [block for block in SECTIONS["delays"](unplanted) if isinstance(block, Table)]
    assert table.header == ["tag", "delay (ns)", "95 % from", "to"]


@pytest.mark.slow
def test_a_campaign_s_tables_have_the_numbers_of_its_test(campaign, page):
    """Shares beyond three sigma by side, and the gains of filters, whose signs must be those of the page."""
    run("calib", "fit", "train.uwb", "-o", "same.json", cwd=campaign)
    run("uwblink", "export", f"{TEST}.uwb", "--to", "csv", "-o", "csv", cwd=campaign)
    own = page_of_numpy.Corrected(campaign / "csv" / "exchanges.csv", campaign / "same.json")
    tables, z = page_of_numpy.Tables(page), (own.full - own.truth) / own.sigma
    for name, rows in own.groups().items():
        told = [page_of_numpy.number(cell) for cell in tables.row(name, "too long")[1:3]]
        assert told == pytest.approx([100 * np.mean(z[rows] > 3), 100 * np.mean(z[rows] < -3)], abs=0.051)
    assert np.mean(z > 3) > np.mean(z < -3)
    mean, against, *tracked = (
        np.array([page_of_numpy.number(cell) for cell in row[1:] if cell[:1].strip()])
        for row in [tables.row(name, "its spread over seeds") for name in ("mean", "against raw")]
        + [row for row in tables.having("its spread over seeds") if row[0].startswith(f"{TEST}.uwb")]
    )
    assert mean == pytest.approx(np.mean(tracked, axis=0), abs=1.1e-3)
    assert against == pytest.approx(100 * (mean[1:] / mean[0] - 1), abs=1.0)
    said = re.search(r"the mean NIS is .*? pass the gate", re.sub(r"<[^>]*>", "", page), re.DOTALL)[0]
    nis, one, _, low, high, _, nees, three, nees_low, nees_high, *_ = map(float, re.findall(r"\d+(?:\.\d+)?", said))
    # Bounds of a mean square are about its expectation: one of a range, three of a position.
    assert (one, three) == (1, 3)
    assert low < 1 < high < 2 < nees_low < 3 < nees_high
    assert 0 < nis < 10
    assert nees > 0
