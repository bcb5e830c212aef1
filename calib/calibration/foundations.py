"""In words what a calibration rests on that was fitted without known distances."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def rests_on(provenance: Mapping[str, Any]) -> str:
    """Return what stands in the place of known distances, as one phrase; "" where distances were known."""
    known = provenance.get("rests_on")
    if provenance.get("truth") != "ranges" or not isinstance(known, Mapping):
        return ""
    parts = [f"ranges alone, of {_listed(known.get('moving'), 'moving body', 'moving bodies')}"]
    seconds = known.get("known_s")
    if isinstance(seconds, int | float) and seconds > 0:
        parts.append(f"positions known for {seconds:.1f} s")
    for key, word in (("anchors_given", "given"), ("anchors_sought", "found")):
        if known.get(key):
            parts.append(f"{_listed(known[key], 'anchor', 'anchors')} at places that were {word}")
    parts.append(f"attitudes from {known.get('attitudes', 'nowhere')}")
    off = provenance.get("distance_std_m")
    if isinstance(off, int | float):
        parts.append(f"distances found to {100 * off:.1f} cm (standard error)")
    return ", ".join(parts)


def _listed(names: object, one: str, many: str) -> str:
    count = len(names) if isinstance(names, list) else 0
    return f"{count} {one if count == 1 else many}"
