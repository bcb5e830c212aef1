"""The scene of a scenario as one HTML page or one picture."""

from __future__ import annotations

import base64
import os
from html import escape
from pathlib import Path
from typing import Final

from uwblink.output import check_output, write_bytes, write_text
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwbsim.errors import ScenarioError
from uwbsim.pages.scenario_figures import picture, png, room, timing
from uwbsim.pages.scenario_summary import preview
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario

PICTURES: Final = (".png", ".svg", ".pdf")
STYLE: Final = """
:root { color-scheme: light dark; --ink: #1a1a1a; --page: #fff; --soft: #f3f5f7; }
@media (prefers-color-scheme: dark) { :root { --ink: #e8e8e8; --page: #16181b; --soft: #22262b; } }
body { font: 16px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--page); max-width: 1040px;
  margin: 0 auto; padding: 1rem; }
img { width: 100%; height: auto; background: #fff; border-radius: .4rem; } figure { margin: 1rem 0; }
pre { background: var(--soft); padding: .6rem; overflow-x: auto; font-size: .85rem; }
"""


def show(scenario: Scenario | Source, path: str | os.PathLike[str], *, force: bool = False) -> None:
    """Write the scene: .html has the room, the timing of every protocol and the preview; a picture has the room.

    `scenario` is whatever `load` takes, or a `Scenario`. Raises `ScenarioError` for a suffix other than .html, .png,
    .svg and .pdf, and what `check_output` raises.

    >>> from pathlib import Path
    >>> import uwbsim
    >>> mast, drone = ({"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0))
    >>> uwbsim.show(
    ...     {
    ...         "run": {"duration_s": 2.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": "mast", "motion": mast}, {"name": "drone", "motion": drone}],
    ...         "tags": [{"id": 1, "body": "mast"}, {"id": 2, "body": "drone"}],
    ...     },
    ...     "scene.png",
    ... )
    >>> Path("scene.png").read_bytes()[1:4]
    b'PNG'
    """
    path = Path(path)
    check_output(path, force=force)
    scenario = as_scenario(scenario)
    suffix = path.suffix.lower()
    if suffix in PICTURES:
        write_bytes(path, picture(room(scenario), suffix[1:], 150), force=force)
    elif suffix == ".html":
        write_text(path, page(scenario), force=force)
    else:
        raise ScenarioError(f"{path}: found {suffix or 'no suffix'}, expected .html, {', '.join(PICTURES)}")


def page(scenario: Scenario) -> str:
    """Return the scene as HTML that needs no other file; text from the scenario is escaped."""
    title = escape(scenario.run.name)
    parts = [
        "<!doctype html><html lang='en'><head><meta charset='utf-8'>",
        "<meta name='viewport' content='width=device-width, initial-scale=1'>",
        f"<title>{title}</title><style>{STYLE}</style></head><body><h1>{title}</h1>",
        figure_html(png(room(scenario)), "Bodies' paths (two minutes at most), tags where they start, obstacles"),
        "<h2>What will happen</h2>",
        f"<pre>{escape(str(preview(scenario)))}</pre>",
        "<h2>One exchange</h2>",
        *(
            figure_html(png(timing(scenario, name)), f"{row.title}: every stamp, and what the paper calls it")
            for name, row in _distinct().items()
        ),
        "</body></html>\n",
    ]
    return "\n".join(parts)


def _distinct() -> dict[str, RangingProtocol]:
    """Return one protocol of each course of messages: formulas make no difference to a picture of them."""
    found: dict[str, RangingProtocol] = {}
    for name, row in PROTOCOLS.items():
        if row.messages not in [other.messages for other in found.values()]:
            found[name] = row
    return found


def figure_html(data: bytes, caption: str) -> str:
    """Return a PNG picture and its caption as HTML."""
    picture = base64.b64encode(data).decode()
    text = escape(caption, quote=True)
    return f"<figure><img alt='{text}' src='data:image/png;base64,{picture}'><figcaption>{text}</figcaption></figure>"
