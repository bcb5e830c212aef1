"""A browser for tests of pages: screenshots, and measurements of pages."""

import json
import re
import shutil
import subprocess
from html import unescape

import pytest

FLAGS = "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking --hide-scrollbars"
MEASURE = """<script>
const wide = [...document.querySelectorAll('body *')].filter(e => e.getClientRects().length &&
  e.getBoundingClientRect().right > innerWidth + 1 && (e.closest('table.words') || !e.closest('.wide, pre, svg')))
  .map(e => e.outerHTML.slice(0, 80));
const text = [...document.querySelectorAll('p, td, th, li, figcaption, h2')].filter(e => e.getClientRects().length)
  .map(e => parseFloat(getComputedStyle(e).fontSize));
const drawn = [...document.querySelectorAll('figure svg')].filter(e => e.getClientRects().length).flatMap(svg =>
  [...svg.querySelectorAll('text')].map(e => parseFloat(getComputedStyle(e).fontSize) * svg.getScreenCTM().a));
parent.postMessage(JSON.stringify({inner: innerWidth, page: document.documentElement.scrollWidth,
  wide: wide.map(t => t.replace(/[<>&]/g, ' ')), text: Math.min(...text), drawn: Math.min(...drawn, 99)}), '*');
</script></body>"""
# In a frame, because a window is never narrower than 500 pixels.
FRAME = """<!doctype html><body><iframe src="{name}" style="width:{width}px;height:2000px;border:0"></iframe><script>
onmessage = event => {{ const told = document.createElement('output'); told.textContent = event.data;
  document.body.replaceChildren(told); }};
</script>"""


def chromium(*arguments, profile):
    """Run Chromium; skips if it is not installed."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if not program:
        pytest.skip("no Chromium is installed to render the page with")
    words = [program, *FLAGS.split(), f"--user-data-dir={profile}", *arguments]
    return subprocess.run(words, check=True, capture_output=True, text=True, timeout=180).stdout


def lies_well(page, width, folder):
    """Assert that nothing of an HTML page (text) exceeds a window of a width, and that all text is large enough."""
    path, frame = folder / f"measured-{width}.html", folder / f"frame-{width}.html"
    path.write_text(page.replace("</body>", MEASURE))
    frame.write_text(FRAME.format(name=path.name, width=width))
    words = ("--virtual-time-budget=10000", "--window-size=1400,2000", "--dump-dom", frame.as_uri())
    dumped = chromium(*words, profile=folder / "profile")
    told = re.search("<output>(.*?)</output>", dumped, re.DOTALL)
    assert told, dumped[-500:]
    found = json.loads(unescape(told[1]))
    assert found["inner"] == width
    assert found["page"] <= width, found["wide"][:5]
    assert found["wide"] == []
    assert found["text"] >= 11
    assert found["drawn"] >= 10
