"""What a survey says of itself: what is determined, which pairs are believed to be reflected, what else to know."""

from __future__ import annotations

from typing import Final

import numpy as np

from calib.information import Unknown, Verdict, judge, reduced
from calib.surveys.adjustment import Adjusted
from calib.surveys.minima import SecondBest
from calib.surveys.network import DETOUR_M
from calib.surveys.result import ReflectedPair
from calib.surveys.scales import DELAY_SCALE_NS, M_PER_NS

PROBABLY: Final = 0.5
PERHAPS: Final = 0.1
"""Probabilities from which a pair is believed to be reflected, and from which it is said that it may be."""


def verdict_of(found: Adjusted) -> Verdict:
    """Return what is determined of the delays, in nanoseconds, whatever places and curve are."""
    columns = found.network.delay_columns
    information = reduced(found.information(), columns.tolist()) * M_PER_NS**2
    return judge(information, [Unknown("delay", str(tag), DELAY_SCALE_NS) for tag in found.network.tags])


def said_of(found: Adjusted, second: SecondBest | None, verdict: Verdict) -> list[str]:
    """Return what a user should know beside reflections, a line each."""
    said = []
    if not found.settled:
        said.append("the search stopped before it settled: delays and places are not final")
    if not verdict.determined.all():
        words = "; ".join(d.words for d in verdict.free)
        said.append(f"not determined, and left out: {words}")
    if found.network.power is not None:
        said.append(
            "a constant of the curve and one of all delays are the same to ranges: what the delays share is known only "
            "as well as the curve at its reference power; differences of delays are known better, and a "
            "taped distance (`known`) tells what they share"
        )
    if second is not None and second.ambiguous:
        who = ", ".join(map(str, second.tags))
        said.append(
            f"{second.arrangement}: another solution agrees as well with the ranges (worse by {second.worse:.1f}), in "
            f"which boards {who} are elsewhere"
        )
    return said


def believed_reflected(found: Adjusted) -> tuple[ReflectedPair, ...]:
    """Return the pairs that may be reflected, the likeliest first."""
    m, names = found.network.means, [place.name for place in found.network.places]
    longer = found.residuals_m[: len(m)] + DETOUR_M * found.network.reflected
    return tuple(
        ReflectedPair(
            names[m.arrangement[k]], int(m.first[k]), int(m.second[k]), float(longer[k]), float(found.chance[k])
        )
        for k in np.argsort(-found.chance, kind="stable").tolist()
        if found.chance[k] >= PERHAPS
    )


def reflections_in_words(reflected: tuple[ReflectedPair, ...]) -> list[str]:
    """Return a line for each pair that is believed to be reflected, and one for those that may be."""
    said = [
        f"{one.arrangement}: the range of {one.first} and {one.second} is {100 * one.longer_m:+.0f} cm off what all "
        f"others say: believed to be reflected ({100 * one.chance:.0f} %), and hardly counted"
        for one in reflected
        if one.chance >= PROBABLY
    ]
    perhaps = [
        f"{one.first}-{one.second} in {one.arrangement} ({100 * one.chance:.0f} %)"
        for one in reflected
        if one.chance < PROBABLY
    ]
    return [*said, *([f"may be reflected, too: {', '.join(perhaps)}; intervals are wider by that"] if perhaps else [])]
