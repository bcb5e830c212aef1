"""Holds that no page of the built site is wider than a telephone: `python -m docs.site.narrow`, part of `make docs`.

A browser without a window shows every page in a frame of 390 pixels, and tells which are wider inside.
"""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

SITE: Final = Path(__file__).parents[1] / "_build" / "html"
WIDTH: Final = 390
BROWSERS: Final = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
TIME_MS: Final = 120_000
SCRIPT: Final = """<body><iframe style="width:WIDTHpx;height:800px;border:0"></iframe><pre id="found"></pre><script>
const pages = PAGES, wide = {}, frame = document.querySelector("iframe");
let at = 0;
frame.onload = () => {
  const inside = frame.contentDocument;
  if (at > 0) {
    const width = inside.documentElement.scrollWidth;
    if (width > WIDTH) {
      const beyond = [...inside.querySelectorAll("article *")].filter(e => e.getBoundingClientRect().right > WIDTH);
      wide[pages[at - 1]] = [width, beyond.slice(0, 3).map(e => e.outerHTML.slice(0, 80))];
    }
  }
  if (at < pages.length) frame.src = pages[at++];
  else document.getElementById("found").textContent = JSON.stringify(wide);
};
frame.src = "about:blank";
</script></body>"""


def browser() -> str | None:
    """Return the path of a browser that can work without a window, None where there is none."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def too_wide(pages: Sequence[Path], program: str) -> dict[str, tuple[int, list[str]]]:
    """Return the pages that are wider than `WIDTH`, with their widths and what sticks out first."""
    script = SCRIPT.replace("WIDTH", str(WIDTH)).replace("PAGES", json.dumps([page.as_uri() for page in pages]))
    with tempfile.TemporaryDirectory() as folder:
        frame = Path(folder) / "frame.html"
        frame.write_text(script, encoding="utf-8")
        words = [program, "--headless", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
        words += [f"--user-data-dir={folder}/profile", f"--virtual-time-budget={TIME_MS}", "--dump-dom", frame.as_uri()]
        done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=True)  # noqa: S603 - a browser
    found = re.search('<pre id="found">(.+?)</pre>', done.stdout, flags=re.S)
    if not found:
        raise RuntimeError(f"{program} did not come to the end of the pages: {done.stderr[-300:]}")
    return {page: (width, beyond) for page, (width, beyond) in json.loads(html.unescape(found[1])).items()}


def main() -> int:
    """Say which pages are too wide; status 1 where there are some."""
    program, pages = browser(), sorted(SITE.rglob("*.html"))
    if program is None:
        sys.stdout.write(f"widths not looked at: no browser found ({', '.join(BROWSERS)})\n")
        return 0
    wide = too_wide(pages, program)
    for page, (width, beyond) in wide.items():
        sys.stdout.write(f"{page}: {width} pixels wide in a window of {WIDTH}: {' '.join(beyond)}\n")
    sys.stdout.write(f"{len(pages) - len(wide)} of {len(pages)} pages fit into {WIDTH} pixels\n")
    return 1 if wide else 0


if __name__ == "__main__":
    raise SystemExit(main())
