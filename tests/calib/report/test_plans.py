"""Pages and figures of plans: everything that a plan says is on them."""

import re
from functools import partial

from typer.testing import CliRunner

import calib
from calib.cli.commands import app
from calib.report.figures import arrangement
from uwblink.pages.figures import picture


def written(folder, *words):
    done = CliRunner().invoke(
        app, ["plan", "survey", *words, "-o", str(folder / "plan.html"), "--figures", str(folder / "f")]
    )
    assert done.exit_code == 0, done.output
    return (folder / "plan.html").read_text(encoding="utf-8"), {path.name for path in (folder / "f").iterdir()}


def words_of(svg):
    """The words in a drawing."""
    return re.findall(r"<text[^>]*>([^<]*)</text>", svg)


def test_boards_have_a_picture_of_each_arrangement_with_tapes_and_intervals(tmp_path):
    page, files = written(tmp_path, "7,12,3", "--on", "line", "--arrangements", "2", "--taped", "1")
    kinds = {f"{width}.{kind}" for width in ("column", "page") for kind in ("pdf", "svg")}
    assert files == {f"{name}-{kind}" for name in ("arrangement-A", "arrangement-B", "more") for kind in kinds}
    drawn = [words_of((tmp_path / "f" / f"arrangement-{name}-page.svg").read_text()) for name in "AB"]
    # Once on the string, once below their bars.
    assert all(words.count(tag) == 2 for words in drawn for tag in ("7", "12", "3"))
    assert sum("distance to tape" in words for words in drawn) == 1
    assert "open" in drawn[0]
    assert "Step 2: arrangement B" in drawn[1]
    assert "before it" in drawn[1]
    assert "Step 2: arrangement B" in page
    assert "calib survey A.uwb B.uwb --known known.toml" in page


def test_boards_in_space_are_seen_from_the_side_as_well():
    plan = calib.plan(5, on="space", arrangements=1)
    words = words_of(picture(partial(arrangement, plan=plan, number=0), "svg").decode())
    assert "height (m)" in words
    assert words.count("5") >= 3


def test_a_flight_has_its_path_its_intervals_and_what_brings_more(tmp_path):
    page = tmp_path / "plan.html"
    words = ["plan", "flight", "2", "--duration", "8", "--rate", "40", "--anchor-tags", "11,12,13,14"]
    done = CliRunner().invoke(app, [*words, "--anchors", "sought", "--poses-until", "4", "-o", str(page)])
    assert done.exit_code == 0, done.output
    text = page.read_text(encoding="utf-8")
    assert {"anchor12", "stays open", "+ the places of the anchors, measured"} <= set(words_of(text))
    assert "Fit delays, curve and trajectories together." in text


def test_a_page_that_is_there_is_not_replaced(tmp_path):
    page = tmp_path / "plan.html"
    page.write_text("mine", encoding="utf-8")
    done = CliRunner().invoke(app, ["plan", "survey", "3", "--arrangements", "1", "-o", str(page)])
    assert "already" in str(done.exception) or "exists" in str(done.exception)
    assert page.read_text(encoding="utf-8") == "mine"
