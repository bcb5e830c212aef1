"""The scene of a scenario as one HTML page or one picture."""

from __future__ import annotations

import os
from functools import partial
from html import escape
from pathlib import Path
from typing import Final

from uwblink.output import check_output, write_bytes, write_text
from uwblink.pages.figures import picture
from uwblink.pages.html import both_widths, page_html
from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS
from uwbsim.errors import ScenarioError
from uwbsim.pages.scenario_figures import room, timing
from uwbsim.pages.scenario_summary import preview
from uwbsim.scenario.loading import Source, as_scenario
from uwbsim.scenario.model import Scenario

PICTURES: Final = (".png", ".svg", ".pdf")


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
        write_bytes(path, picture(partial(room, scenario=scenario), suffix[1:]), force=force)
    elif suffix == ".html":
        write_text(path, page(scenario), force=force)
    else:
        raise ScenarioError(f"{path}: found {suffix or 'no suffix'}, expected .html, {', '.join(PICTURES)}")


def page(scenario: Scenario) -> str:
    """Return the scene as HTML that needs no other file; text from the scenario is escaped."""
    parts = [
        both_widths(
            partial(room, scenario=scenario),
            "Bodies' paths (two minutes at most), tags where they start, obstacles, the room's walls; to scale.",
            "room",
        ),
        "<h2>What will happen</h2>",
        f"<pre class='table'>{escape(str(preview(scenario)))}</pre>",
        "<h2>One exchange</h2>",
        "<p>Every stamp, and what the paper calls it; pale: preamble and start of frame, full: header and data. dt41 "
        "is the initiator's round trip, dt32 the target's reply, dt53 and dt64 the third leg as its sender and its "
        "receiver have it.</p>",
        *(
            both_widths(partial(timing, scenario=scenario, name=name), f"{row.title}.", f"timing {name}")
            for name, row in _distinct().items()
        ),
    ]
    return page_html(scenario.run.name, parts)


def _distinct() -> dict[str, RangingProtocol]:
    """Return one protocol of each course of messages: formulas make no difference to a picture of them."""
    found: dict[str, RangingProtocol] = {}
    for name, row in PROTOCOLS.items():
        if row.messages not in [other.messages for other in found.values()]:
            found[name] = row
    return found
