"""What a page does when pointed at, in a browser: values under the pointer, one line alone, a closer look."""

import json
import re
from html import unescape

import pytest

from tests.browser import chromium
from uwblink.pages.blocks import Document, Picture, to_html
from uwblink.pages.colours import look
from uwblink.pages.figures import label, legend, mark, sheet

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


def test_it_says_the_values_under_the_pointer(told):
    assert told["before"] == "none"
    shown, (x, y) = told["reading"]
    assert shown == "block"
    # A step of a reading is a two-hundredth of the axis.
    assert float(x.removeprefix("time (s): ")) == pytest.approx(30, abs=0.5)
    assert float(y.removeprefix("error (cm): ")) == pytest.approx(3, abs=0.05)


def test_a_line_that_is_pointed_at_is_named_and_stands_alone(told):
    assert told["series"] == ["tag 1", True, [False, True]]
    assert told["away"] == ["none", False], "and nothing of it stays"


def test_a_click_shows_a_figure_closer(told):
    assert told["open"]
    assert told["closed"]
    whole, closer, moved = told["whole"], told["closer"], told["moved"]
    assert closer[2] < 0.6 * whole[2]
    assert closer[2] / closer[3] == pytest.approx(whole[2] / whole[3])
    assert closer[0] > whole[0]
    assert moved[0] < closer[0], "dragged to the right, what is at the left comes"
    assert moved[1:] == pytest.approx(closer[1:])
    assert told["again"] == pytest.approx(whole)
