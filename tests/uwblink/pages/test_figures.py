"""Figures at paper size, and drawings as parts of pages."""

import base64
import io
import itertools
import json
import re
from html import unescape

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from pypdf import PdfReader

from tests.browser import chromium, lies_well
from uwblink.pages.blocks import (
    CSS,
    VARIABLES,
    Block,
    Document,
    Listing,
    Picture,
    Table,
    Text,
    inline,
    table_html,
    to_html,
)
from uwblink.pages.colours import BLUE, DARK, GRID, INK, MUTED, PALE, SERIES, look
from uwblink.pages.figures import (
    WIDTHS,
    drawn,
    label,
    legend,
    mark,
    notebook_image,
    picture,
    sheet,
    values_over_time,
)


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


@pytest.mark.slow
def test_figures_are_drawn_once_for_all_files():
    calls = []

    def draw(width_in):
        calls.append(width_in)
        return two_panels(width_in)

    files = drawn(draw, 3.5, ["svg", "pdf", "png"])
    assert PdfReader(io.BytesIO(files["pdf"])).pages[0].mediabox.width == pytest.approx(252, abs=0.1)
    assert (calls, files["png"][:4], b'width="252pt"' in files["svg"]) == ([3.5], b"\x89PNG", True)
    assert files == drawn(two_panels, 3.5, ["svg", "pdf", "png"]), "the same bytes each time"


def test_colours_of_a_drawing_become_those_of_the_page():
    page = inline(drawn(two_panels, 7.16, ["svg"], salt="one")["svg"], "it's <one>")
    assert page.startswith("<svg viewBox=")
    assert [text for text in ("<one>", *DARK) if text in page] == []
    for text in ("it&#x27;s &lt;one&gt;", f"var({VARIABLES[BLUE]})", f"var({VARIABLES[INK]})"):
        assert text in page
    other = inline(drawn(two_panels, 7.16, ["svg"], salt="other")["svg"], "")
    one_ids, other_ids = ({*re.findall(r'id="([^"]*)"', text)} for text in (page, other))
    assert not one_ids & other_ids, "ids that two drawings of a page would share"
    assert {f"tag {k}" for k in range(12)} <= set(re.findall(r'data-name="([^"]*)"', page))


def test_pages_have_positions_and_axes_of_panels():
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


@pytest.mark.parametrize("width", [pytest.param(1280, marks=pytest.mark.slow), 390])
def test_pages_fit_into_windows(width, tmp_path):
    blocks: list[Block] = [
        Picture("two", two_panels, "A caption. " * 12),
        Table(["pair", *(f"column {k}" for k in range(20))], [["1-2", *("12345.6" for _ in range(20))]] * 3),
        Table(["what", "is"], [["a question " * 9, "an answer " * 9], ["file", "0a" * 32]], words=True),
        Text(f"{'word ' * 60}. {'x' * 90}", "bad"),
        Listing("y" * 300),
    ]
    lies_well(to_html(Document("A page", blocks)), width, tmp_path)


def test_a_picture_is_on_white():
    assert np.all(imread(io.BytesIO(picture(lambda width_in: Figure(figsize=(width_in, 1)), "png"))) == 1)


def test_known_values_are_drawn_over_time_and_far_ones_leave_the_rest_visible():
    time_ns = np.arange(2000, dtype=np.int64) * 10_000_000 + 5_000_000_000
    values = np.sin(np.arange(2000.0))
    values[7], values[11] = np.nan, 400.0
    axes = values_over_time(7.0, time_ns, values, "error (cm)").axes[0]
    (line,) = axes.lines
    drawn_values = np.column_stack([line.get_xdata(), line.get_ydata()])
    np.testing.assert_allclose(drawn_values, np.delete(np.column_stack([np.arange(2000) * 0.01, values]), 7, 0))
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time (s)", "error (cm)")
    assert axes.get_ylim()[1] < 2
    untimed = values_over_time(7.0, np.zeros(2000, dtype=np.int64), values, "").axes[0]
    assert ("number" in untimed.get_xlabel(), untimed.lines[0].get_xdata()[:8].tolist()) == (True, [*range(7), 8])
    assert values_over_time(7.0, time_ns[:0], values[:0], "").axes[0].lines[0].get_xdata().size == 0


def test_an_image_of_a_notebook_is_the_picture_and_its_text_is_escaped():
    page = notebook_image(two_panels, 'a "<b>"')
    assert base64.b64decode(re.search('base64,([^"]*)', page)[1]) == picture(two_panels, "png")
    assert 'alt="a &quot;&lt;b&gt;&quot;"' in page


def test_cells_of_words_have_their_heading():
    words = table_html(["criterion", "met", "asked for"], [["is it <so>?", "yes", ""]], words=True)
    assert "<td>is it &lt;so&gt;?</td><td data-head='met'>yes</td><td></td>" in words
    assert ">set <code>a&lt;b&gt;</code>, or `</td>" in table_html(["what"], [["set `a<b>`, or `"]])
    assert "<code>fixed_ns</code> &lt;i&gt;" in to_html(Document("A page", [Text("pin `fixed_ns` <i>")]))
    assert "data-head" not in table_html(["file", "what"], [["a.uwb", "SHA-256"]], words=True)
    assert "data-head" not in table_html(["pair", "mean", "std"], [["1-2", "3.0", "1.0"]])


# Colours for all eyes: how far apart they are, seen with and without all cones, and how they stand out.


# Machado, Oliveira and Fernandes 2009, severity 1, on linear RGB.
EYES = {
    "all": np.eye(3),
    "no long cones": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "no middle cones": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "no short cones": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


TO_XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.119192, 0.9503041]]
)


def linear(colour):
    part = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return np.where(part <= 0.04045, part / 12.92, ((part + 0.055) / 1.055) ** 2.4)


def lab(rgb):
    t = TO_XYZ @ np.clip(rgb, 0, 1) / np.array([0.95047, 1.0, 1.08883])
    f = np.where(t > 0.008856, np.cbrt(t), 7.787 * t + 16 / 116)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(one, two):
    (l1, a1, b1), (l2, a2, b2) = one, two
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    g = 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25**7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.degrees(np.arctan2(b1, a1)) % 360, np.degrees(np.arctan2(b2, a2)) % 360
    turn = (h2 - h1 + 180) % 360 - 180
    dl, dc, dh = l2 - l1, c2 - c1, 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2))
    h, lightness, c = (h1 + turn / 2) % 360, (l1 + l2) / 2, (c1 + c2) / 2
    t = (
        1 - 0.17 * np.cos(np.radians(h - 30)) + 0.24 * np.cos(np.radians(2 * h))
        + 0.32 * np.cos(np.radians(3 * h + 6)) - 0.2 * np.cos(np.radians(4 * h - 63))
    )  # fmt: skip
    sl = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    sc, sh = 1 + 0.045 * c, 1 + 0.015 * c * t
    rt = -np.sin(np.radians(60 * np.exp(-(((h - 275) / 25) ** 2)))) * 2 * np.sqrt(c**7 / (c**7 + 25**7))
    return np.sqrt((dl / sl) ** 2 + (dc / sc) ** 2 + (dh / sh) ** 2 + rt * dc / sc * dh / sh)


GROUND = {"light": "#ffffff", "dark": "#16181b"}


def contrast(one, two):
    """WCAG 2.2, relative luminance."""
    bright, dim = sorted((float(linear(c) @ [0.2126, 0.7152, 0.0722]) for c in (one, two)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


@pytest.mark.parametrize(
    ("one", "two", "apart"),
    [
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((50.0, 2.5, 0.0), (73.0, 25.0, -18.0), 27.1492),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
    ],
)
def test_the_measure_is_the_published_one(one, two, apart):
    # Sharma, Wu and Dalal 2005, pairs 1, 17 and 34.
    assert ciede2000(one, two) == pytest.approx(apart, abs=1e-4)


@pytest.mark.parametrize("eyes", list(EYES))
@pytest.mark.parametrize("ground", ["light", "dark"])
def test_colours_of_series_are_distinct(eyes, ground):
    shown = [colour if ground == "light" else DARK[colour] for colour in SERIES]
    seen = [lab(EYES[eyes] @ linear(colour)) for colour in shown]
    apart = {(a, b): ciede2000(seen[a], seen[b]) for a, b in itertools.combinations(range(len(seen)), 2)}
    assert min(apart.values()) >= 15, apart


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_lines_and_text_of_figures_have_contrast(ground):
    # The last two must not stand out, and still show.
    asked = dict.fromkeys(SERIES, 3.0) | {INK: 4.5, MUTED: 4.5, GRID: 1.3, PALE: 1.8}
    for colour, least in asked.items():
        assert contrast(colour if ground == "light" else DARK[colour], GROUND[ground]) >= least, colour


@pytest.mark.parametrize("ground", ["light", "dark"])
def test_text_of_pages_has_contrast(ground):
    light, dark = CSS[: CSS.index("* {")].split("@media screen and (prefers-color-scheme: dark)")
    colours = dict(re.findall(r"(--[a-z-]+):\s*(#[0-9a-f]{3,6})", light if ground == "light" else dark))
    full = {name: c if len(c) == 7 else "#" + "".join(2 * x for x in c[1:]) for name, c in colours.items()}
    assert full["--page"] == GROUND[ground]
    for word in ("--ink", "--quiet", "--link"):
        for under in ("--page", "--soft", "--good", "--doubt", "--bad"):
            assert contrast(full[word], full[under]) >= 4.5, (word, under)


def test_many_series_differ_also_without_colour():
    found = [look(k) for k in range(40)]
    assert len({(one.colour, one.marker, str(one.dashes)) for one in found}) == 40
    assert len({(one.marker, str(one.dashes)) for one in found[:12]}) == 12, "without any colour"


# What a page does when pointed at, in a browser: values under the pointer, one line alone, a closer look.


POINTED_AT = """<script>
const told = {}, wide = document.querySelector('figure .wide svg'), tip = document.getElementById('tip');
const panel = JSON.parse(wide.dataset.panels)[0];
const at = (x, y) => { const [left, top, right, bottom] = panel.box;
  const u = (x - panel.x[0]) / (panel.x[1] - panel.x[0]), v = (y - panel.y[0]) / (panel.y[1] - panel.y[0]);
  return new DOMPoint(left + u * (right - left), bottom - v * (bottom - top)).matrixTransform(wide.getScreenCTM()); };
const send = (kind, target, point, more) => target.dispatchEvent(
  new (kind === 'wheel' ? WheelEvent : PointerEvent)(kind,
    {bubbles: true, cancelable: true, clientX: point.x, clientY: point.y, ...more}));
const lines = () => [...tip.children].map(one => one.textContent);
const half = at(30, 3);
told.before = getComputedStyle(tip).display;
send('pointermove', wide, half);
told.reading = [getComputedStyle(tip).display, lines()];
const series = [...wide.querySelectorAll('.series')], path = series[1].querySelector('path');
send('pointermove', path, half);
told.series = [lines()[0], wide.classList.contains('one'), series.map(one => one.classList.contains('here'))];
send('pointermove', document.querySelector('h1'), half);
told.away = [getComputedStyle(tip).display, wide.classList.contains('one')];
wide.dispatchEvent(new MouseEvent('click', {bubbles: true}));
const zoom = document.getElementById('zoom'), copy = zoom.querySelector('svg');
const box = () => { const {x, y, width, height} = copy.viewBox.baseVal; return [x, y, width, height]; };
told.whole = box();
const middle = copy.getBoundingClientRect(), spot = {x: middle.x + middle.width / 2, y: middle.y + middle.height / 2};
send('wheel', copy, spot, {deltaY: -400});
told.closer = box();
send('pointermove', copy, spot, {buttons: 1, movementX: 50, movementY: 0});
told.moved = box();
send('dblclick', copy, spot);
told.again = box();
told.open = zoom.open;
zoom.querySelector('button').click();
told.closed = !zoom.open;
setTimeout(() => { const found = document.createElement('output'); found.textContent = JSON.stringify(told);
  document.body.replaceChildren(found); }, 300);
</script></body>"""


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What the page did, one pointer after the other."""

    def two_lines(width_in):
        figure, (axes,) = sheet(width_in)
        for k in range(2):
            (line,) = axes.plot([0, 60], [k, 6 - k], label=f"tag {k}", **look(k).line())
            mark(line, f"tag {k}")
        axes.set(xlim=(0, 60), ylim=(0, 6))
        label(axes, "time (s)", "error (cm)")
        legend(figure)
        return figure

    page = to_html(Document("A page", [Picture("two", two_lines, "Two lines.")]))
    folder = tmp_path_factory.mktemp("page")
    path = folder / "page.html"
    path.write_text(page.replace("</body>", POINTED_AT))
    words = ("--virtual-time-budget=4000", "--window-size=1280,900", "--dump-dom", path.as_uri())
    found = re.search("<output>(.*?)</output>", chromium(*words, profile=folder / "profile"), re.DOTALL)
    assert found, "the script did not come to its end"
    return json.loads(unescape(found[1]))


def test_pages_show_values_at_the_pointer(told):
    shown, (x, y) = told["reading"]
    assert (told["before"], shown) == ("none", "block")
    # A step of a reading is a two-hundredth of the axis.
    assert float(x.removeprefix("time (s): ")) == pytest.approx(30, abs=0.5)
    assert float(y.removeprefix("error (cm): ")) == pytest.approx(3, abs=0.05)


def test_lines_at_the_pointer_are_named_and_highlighted(told):
    assert told["series"] == ["tag 1", True, [False, True]]
    assert told["away"] == ["none", False], "and nothing of it stays"


def test_a_click_shows_a_figure_closer(told):
    whole, closer, moved = told["whole"], told["closer"], told["moved"]
    assert (told["open"], told["closed"], closer[2] < 0.6 * whole[2]) == (True, True, True)
    assert closer[2] / closer[3] == pytest.approx(whole[2] / whole[3])
    # Dragged to the right, what is at the left comes.
    assert closer[0] > max(whole[0], moved[0])
    assert (moved[1:], told["again"]) == (pytest.approx(closer[1:]), pytest.approx(whole))
