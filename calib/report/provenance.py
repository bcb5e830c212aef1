"""What every report says of its calibration: what to doubt, and where both come from."""

from __future__ import annotations

import json
from typing import Final

from calib.calibration.model import Calibration, rests_on
from calib.report.blocks import Block, Heading, Listing, Table, Text
from calib.report.origin import Origin


def warnings(sentences: list[str]) -> list[Block]:
    """Return a paragraph a warning."""
    return [Text(f"Warning: {sentence}", "warning") for sentence in sentences]


SHOWN: Final = {"surveyed", "reflected"}
"""Of a calibration's provenance what a section shows as tables and figures."""


def provenance(calibration: Calibration, origin: Origin) -> list[Block]:
    """Return where a report and its calibration come from."""
    made = [["report", origin.made], ["version", origin.version], ["command", origin.command]]
    made.append(["distances", rests_on(calibration.provenance)])
    rows = [row for row in made if row[1]] + [[path, f"SHA-256 {digest}"] for path, digest in origin.files.items()]
    return [
        Heading("Provenance"),
        Table(["of", "what"], rows, words=True),
        Listing(json.dumps({k: v for k, v in calibration.provenance.items() if k not in SHOWN}, indent=1)),
    ]
