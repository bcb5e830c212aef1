"""One range of a stream: what the board said, and what a calibration makes of it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from uwblink.boards.listeners import Correction
from uwblink.twr import Exchanges

ENDS: Final = ("time_ns", "initiator", "target")
LEVELS: Final = ("fpp1_dbm", "fpp2_dbm", "skew1_ppm", "skew2_ppm")


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamedRange:
    """A range in metres, when its exchange began (host time, Unix epoch), and of whom.

    `range_m` is as the board reported it. `corrected_m` and its standard deviation `sigma_m` are NaN without a
    calibration, and for tags that it does not know; `more` is what else the correction says, such as `clamped`.

    >>> import uwblink
    >>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
    >>> uwblink.Contents(exchanges=x).save("mine.uwb")
    >>> [round(one.range_m, 2) for one in uwblink.stream("mine.uwb", speed=100.0)]
    [4.69]
    """

    time_ns: int
    initiator: int
    target: int
    range_m: float
    fpp1_dbm: float
    fpp2_dbm: float
    skew1_ppm: float
    skew2_ppm: float
    corrected_m: float = math.nan
    sigma_m: float = math.nan
    more: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return what is known, by name; numbers that are none are left out, because JSON has no word for them."""
        ends = {name: getattr(self, name) for name in ENDS}
        levels = {name: getattr(self, name) for name in ("range_m", "corrected_m", "sigma_m", *LEVELS)}
        return ends | {name: value for name, value in (levels | dict(self.more)).items() if math.isfinite(value)}

    def to_json(self) -> str:
        """Return the same as one line of JSON, without its end."""
        return json.dumps(self.to_dict(), allow_nan=False)


def streamed(exchanges: Exchanges, correct: Correction | None) -> Iterator[StreamedRange]:
    """Yield exchanges as ranges of a stream, corrected where there is a correction."""
    names = (*ENDS, "range_m", *LEVELS)
    known = {name: column.tolist() for name, column in (correct(exchanges) if correct else {}).items()}
    own = {name: known.pop(name) for name in ("corrected_m", "sigma_m") if name in known}
    columns = {name: getattr(exchanges, name).tolist() for name in names} | own
    for row in range(len(exchanges)):
        more = {name: column[row] for name, column in known.items()}
        yield StreamedRange(more=more, **{name: column[row] for name, column in columns.items()})
