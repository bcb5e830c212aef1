"""The report: one file that needs nothing else, and shows what it must."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from calib.cli.reporting import spread
from calib.estimation.fitting import fit
from calib.report.report import render
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
    assert page.count("<figure>") == 7
    assert page.count("alt='") == 7


def test_without_planted_truth_there_is_no_such_column():
    r = ranges(2000)
    assert "planted (ns)" not in render([r], fit(r).calibration)


ROOT = Path(__file__).parents[3]
BIN = Path(sys.executable).parent


def run(*arguments, cwd):
    done = subprocess.run([BIN / arguments[0], *arguments[1:]], capture_output=True, text=True, cwd=cwd)
    assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A training flight with passive listeners, a test flight, and the report of both in every form."""
    folder = tmp_path_factory.mktemp("campaign")
    for name, seed in (("train", 1), ("test", 2)):
        settings = [f"run.seed={seed}", "run.duration_s=15", "tags.0.passive=true"]
        options = [word for setting in settings for word in ("--set", setting)]
        run("uwbsim", "run", ROOT / "scenarios/icra2023/train.toml", "-o", f"{name}.uwb", *options, cwd=folder)
    words = [
        "report",
        "train.uwb",
        "--tests",
        "test.uwb",
        "-o",
        "r.html",
        "--pdf",
        "r.pdf",
        "--figures",
        "figures",
        "--json",
    ]
    (folder / "r.json").write_text(run("calib", *words, cwd=folder).stdout)
    return folder


def test_the_campaign_has_every_section_in_order(campaign):
    page = (campaign / "r.html").read_text()
    sections = re.findall("<h2>(.*?)</h2>", page)
    assert sections == [
        "What was recorded", "Is it determined?", "Antenna delays", "Bias and standard deviation over power",
        "Before and after", "Outliers", "Localization", "Over time", "Provenance",
    ]  # fmt: skip
    assert "heard by others" in page
    assert "these flights are simulated, so metres do not compare" in page
    assert page.count("class='many'") == 2, "the tables by pair are set smaller"
    assert not re.findall(r"(?:src|href)=['\"](?!data:)", page)


def test_every_figure_comes_as_a_file_at_paper_size(campaign):
    names = {path.stem for path in (campaign / "figures").iterdir()}
    assert len(names) == (campaign / "r.html").read_text().count("<figure>")
    for name in names:
        assert (campaign / "figures" / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert "<svg" in (campaign / "figures" / f"{name}.svg").read_text()


def test_the_pdf_is_one_with_pages(campaign):
    data = (campaign / "r.pdf").read_bytes()
    assert data.startswith(b"%PDF")
    assert 5 <= len(re.findall(rb"/Type /Page\b", data)) <= 20


def test_the_json_tells_what_the_page_tells(campaign):
    import json

    document = json.loads((campaign / "r.json").read_text())
    assert {"calibration", "warnings", "evaluation", "heard", "findings", "localization"} == set(document)
    assert document["evaluation"]["overall"]["full"]["n"] == 2400
    assert document["evaluation"]["planted"]["correction_rms_m"] < 0.02


@pytest.mark.parametrize("width", [1280, 390])
def test_a_browser_shows_it(campaign, tmp_path, width):
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not chromium:
        pytest.skip("no Chromium is installed to render the page with")
    picture = tmp_path / "page.png"
    flags = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --hide-scrollbars"
    subprocess.run(
        [chromium, *flags.split(), f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},2400",
         f"--screenshot={picture}", (campaign / "r.html").as_uri()],
        check=True, capture_output=True, timeout=60,
    )  # fmt: skip
    pixels = imread(picture)
    assert pixels.shape[:2] == (2400, width)
    # Text and figures from top to bottom: no band of the page is blank.
    bands = np.array_split(pixels[..., :3].std(axis=(1, 2)), 8)
    assert all(band.max() > 0.05 for band in bands)


def test_tests_take_several_files():
    told = ["report", "a", "-o", "r", "--tests", "b", "c", "--force", "d"]
    assert spread(told) == ["report", "a", "-o", "r", "--tests", "b", "--tests", "c", "--force", "d"]
    assert spread(["fit", "a", "-o", "c"]) == ["fit", "a", "-o", "c"]
