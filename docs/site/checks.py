"""The tables of the doctor's checks and of the findings of fits, out of the code that makes them."""

from __future__ import annotations

import re
from typing import Final

from calib.checks.examine import CHECKS
from calib.findings import REMEDIES

HEAD: Final = "| question | statistic; distribution on sound data | faults, and what to do |\n|---|---|---|"


def reference() -> str:
    """Return the Markdown of the checks, with each fault's remedy."""
    rows = [
        f"| {check.question} | {check.statistic}; {check.sound} | "
        f"{'<br>'.join(f'**{fault}**: {_plain(remedy)}' for fault, remedy in check.remedies.items())} |"
        for check in CHECKS
    ]
    return "\n".join([HEAD, *rows])


def warnings() -> str:
    """Return the Markdown of the findings of fits and surveys, with their remedies."""
    rows = [f"| {fault} | {_plain(remedy)} |" for fault, remedy in REMEDIES.items()]
    return "\n".join(["| finding | what to do |\n|---|---|", *rows])


def _plain(remedy: str) -> str:
    """Return a remedy with its fields in capitals, as in help texts."""
    if remedy == "{more}":
        return "depends on the recording; the finding says it"
    return re.sub(r"\{(\w+)\}", lambda found: found[1].upper(), remedy).replace("|", "\\|")
