"""The interface of corrections of arriving ranges, which other distributions implement."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from uwblink.recording.antenna_delays import AntennaDelays
from uwblink.twr import Exchanges

Columns = Mapping[str, NDArray[Any]]
"""Columns by name."""


@dataclass(frozen=True, slots=True)
class Correction:
    """A correction, called with exchanges (n,).

    `ranges` returns columns (n,) for exchanges: `corrected_m` and `sigma_m` in metres, and others; NaN where a value is
    not known. It raises a `ValueError` for exchanges that it cannot correct, for example of a tag that is not
    calibrated. `differences`, where there is one, takes exchanges and columns of the table `overheard`, and returns
    columns of differences of arrival, named like the fields of `uwblink.streaming.StreamedDifference`.
    `antenna_delays` are the programmed antenna delays for which it is valid.
    """

    ranges: Callable[[Exchanges], Columns]
    differences: Callable[[Exchanges, Columns], Columns] | None = None
    antenna_delays: AntennaDelays = field(default_factory=dict)

    def __call__(self, exchanges: Exchanges) -> Columns:
        """Return the columns of corrected ranges."""
        return self.ranges(exchanges)
