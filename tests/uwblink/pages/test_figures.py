"""Figures at paper size, and drawings as parts of pages."""

import json
import re
from html import unescape

import numpy as np
import pytest
from matplotlib.figure import Figure

from tests.browser import lies_well
from uwblink.pages.blocks import VARIABLES, Block, Document, Listing, Picture, Table, Text, inline, table_html, to_html
from uwblink.pages.colours import BLUE, DARK, INK, look
from uwblink.pages.figures import WIDTHS, drawn, label, legend, mark, picture, sheet


def two_panels(width_in):
    figure, panels = sheet(width_in, 2)
    for axes in panels:
        for k in range(12):
            (line,) = axes.plot([1, 10, 100], [k, k + 1, k], label=f"tag {k}", **look(k).line())
            mark(line, f"tag {k}")
        label(axes, "time (s)", "error (cm)")
    panels[1].set_xscale("log")
    legend(figure)
    return figure


def test_panels_stand_beside_each_other_on_a_page_and_above_each_other_in_a_column():
    wide, narrow = (sheet(width, 2)[0] for width in (7.16, 3.5))
    assert [axes.get_subplotspec().get_geometry()[:2] for axes in (wide.axes[0], narrow.axes[0])] == [(1, 2), (2, 1)]


def test_it_is_drawn_once_for_all_files():
    calls = []

    def draw(width_in):
        calls.append(width_in)
        return two_panels(width_in)

    files = drawn(draw, 3.5, ["svg", "pdf", "png"])
    assert calls == [3.5]
    assert files["pdf"].startswith(b"%PDF")
    assert files["png"].startswith(b"\x89PNG")
    assert b'width="252pt"' in files["svg"]
    assert files == drawn(two_panels, 3.5, ["svg", "pdf", "png"]), "the same bytes each time"


def test_colours_of_a_drawing_become_those_of_the_page():
    page = inline(drawn(two_panels, 7.16, ["svg"], salt="one")["svg"], "it's <one>")
    assert page.startswith("<svg viewBox=")
    assert "<one>" not in page
    assert "it&#x27;s &lt;one&gt;" in page
    for colour in DARK:
        assert colour not in page
    assert f"var({VARIABLES[BLUE]})" in page
    assert f"var({VARIABLES[INK]})" in page
    shared = re.findall(r'id="([^"]*)"', page)
    other = re.findall(r'id="([^"]*)"', inline(drawn(two_panels, 7.16, ["svg"], salt="other")["svg"], ""))
    assert not set(shared) & set(other), "ids that two drawings of a page would share"
    assert {f"tag {k}" for k in range(12)} <= set(re.findall(r'data-name="([^"]*)"', page))


def test_a_page_knows_what_each_panel_shows():
    page = inline(picture(two_panels, "svg"), "")
    left, right = json.loads(unescape(re.search("data-panels='([^']*)'", page)[1]))
    assert left["names"] == ["time (s)", "error (cm)"]
    assert (left["scale"], right["scale"]) == (["linear", "linear"], ["log", "linear"])
    assert left["box"][0] < left["box"][2] <= right["box"][0] < right["box"][2] <= 72 * WIDTHS["page"]
    # The first tick of the left panel lies where the box and the axis say.
    x = float(re.search(r'<use xlink:href="#m[0-9a-f]+" x="([0-9.]+)"', page)[1])
    share = (x - left["box"][0]) / (left["box"][2] - left["box"][0])
    at = left["x"][0] + share * (left["x"][1] - left["x"][0])
    assert at == pytest.approx(round(at / 20) * 20, abs=0.5)


@pytest.mark.parametrize("width", [1280, 390])
def test_a_page_lies_well(width, tmp_path):
    header = ["pair", *(f"column {k}" for k in range(20))]
    blocks: list[Block] = [
        Picture("two", two_panels, "A caption. " * 12),
        Table(header, [["1-2", *("12345.6" for _ in range(20))]] * 3),
        Table(["what", "is"], [["a question " * 9, "an answer " * 9], ["file", "0a" * 32]], words=True),
        Text(f"{'word ' * 60}. {'x' * 90}", "bad"),
        Listing("y" * 300),
    ]
    lies_well(to_html(Document("A page", blocks)), width, tmp_path)


def test_a_picture_is_on_white():
    import io

    from matplotlib.image import imread

    def draw(width_in):
        return Figure(figsize=(width_in, 1))

    assert np.all(imread(io.BytesIO(picture(draw, "png"))) == 1)


def test_cells_of_words_say_what_they_are_where_no_heading_is_above_them():
    words = table_html(["criterion", "met", "asked for"], [["is it <so>?", "yes", ""]], words=True)
    assert "<td>is it &lt;so&gt;?</td><td data-head='met'>yes</td><td></td>" in words
    assert ">set <code>a&lt;b&gt;</code>, or `</td>" in table_html(["what"], [["set `a<b>`, or `"]])
    assert "<code>fixed_ns</code> &lt;i&gt;" in to_html(Document("A page", [Text("pin `fixed_ns` <i>")]))
    assert "data-head" not in table_html(["file", "what"], [["a.uwb", "SHA-256"]], words=True)
    assert "data-head" not in table_html(["pair", "mean", "std"], [["1-2", "3.0", "1.0"]])
