"""Delays that a fit takes from a calibration."""

from __future__ import annotations

import os
from collections.abc import Iterable

from calib.calibration.model import Calibration, load_calibration, require_calibration
from calib.data.ranges import Ranges
from calib.errors import BadInputError


def imported(source: Calibration | str | os.PathLike[str] | None, parameter: str = "delays_from") -> Calibration | None:
    """Return the calibration that is given as an object or as its path; errors name `parameter`."""
    if source is None:
        return None
    known = load_calibration(source) if isinstance(source, str | os.PathLike) else source
    require_calibration(known, parameter)
    return known


def taken_over(known: Calibration | None, ranges: Ranges, *, curve: bool) -> dict[int, float]:
    """Return the delays that a calibration has for tags of these ranges.

    Raises `BadInputError` where it has none, and where it has all and no `curve` is fitted beside them.
    """
    if known is None:
        return {}
    found = {tag: known.delays_ns[tag] for tag in ranges.tags() if tag in known.delays_ns}
    if not found:
        there, here = (", ".join(map(str, sorted(tags))) for tags in (known.delays_ns, ranges.tags()))
        raise BadInputError(f"its tags are {there}, those of the ranges {here}", parameter="delays_from")
    if not curve and len(found) == len(ranges.tags()):
        raise BadInputError(
            "it has the delays of all tags, and `delays_only` fits no curve, so nothing is left to fit",
            parameter="delays_from",
        )
    return found


def std_taken_over(known: Calibration | None, tags: Iterable[int]) -> dict[int, float]:
    """Return the standard errors of delays that were taken from a calibration."""
    return {} if known is None else {tag: known.delays_std_ns[tag] for tag in tags if tag in known.delays_std_ns}
