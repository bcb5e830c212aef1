"""What a user should know before trusting a fit."""

from __future__ import annotations

from typing import Final

from calib.data.ranges import STATIC, Ranges
from uwblink.recording.antenna_delays import known_delays

MANY_MISSING: Final = 0.05
MANY_OUTLIERS: Final = 0.4
SHORT_S: Final = 25.0


def warnings_of(ranges: Ranges, inliers: float, free: list[list[int]], seconds: float) -> list[str]:
    """Return sentences, the gravest first.

    `inliers` is the share of ranges within three sigmas, `seconds` the time that ranges cover.
    """
    found = []
    if free:
        groups = "; ".join(", ".join(map(str, group)) for group in free)
        found.append(
            f"the data leave the delays of tags {groups} free; those written are the smallest that agree with the data"
        )
    delays = known_delays(ranges.antenna_delays, ranges.tags())
    apart = [f"{tag} ({one})" for tag, one in delays.items() if tag is not None and one.reply != one.tx]
    if apart:
        found.append(
            f"the stamps of tag{'s' * (len(apart) > 1)} {', '.join(apart)} carry two antenna delays, the register's "
            "and another constant in those of delayed replies: no delay of a tag fits both; program the firmware's "
            "constants, too (`calib export --to firmware`), and record anew"
        )
    everything = len(ranges) + sum(ranges.excluded.values())
    for reason, count in ranges.excluded.items():
        if reason != STATIC and count > MANY_MISSING * everything:
            found.append(f"{100 * count / everything:.0f} % of the exchanges were left out: {reason}")
    if 1 - inliers > MANY_OUTLIERS:
        found.append(f"{100 * (1 - inliers):.0f} % of the ranges lie beyond three sigmas of the calibrated errors")
    if seconds < SHORT_S:
        found.append(f"only {seconds:.0f} s of data: errors that persist are few, so intervals may be too narrow")
    return found
