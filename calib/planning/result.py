"""A plan: a procedure in steps, the interval that each delay will have, and what one more measurement would bring."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from calib.information import Verdict


@dataclass(frozen=True, slots=True)
class PlannedArrangement:
    """One arrangement: its name, where about the boards stand (metres, by tag), and distances to tape, by pairs."""

    name: str
    place_m: Mapping[int, tuple[float, float, float]]
    taped: tuple[tuple[int, int], ...]

    def order(self) -> tuple[int, ...]:
        """Return the tags in the order in which they lie along x."""
        return tuple(sorted(self.place_m, key=lambda tag: self.place_m[tag]))

    def where(self, on: str) -> str:
        """Return in words where boards stand on a "line", a "plane", or in a room ("")."""
        if on == "line":
            return "in the order " + " ".join(map(str, self.order()))
        axes = 2 if on == "plane" else 3
        spots = (f"{tag} at ({', '.join(f'{v:.1f}' for v in p[:axes])})" for tag, p in self.place_m.items())
        return f"with {', '.join(spots)}"


@dataclass(frozen=True, slots=True)
class NextBest:
    """What one more measurement would bring: what it is, and the mean half interval (ns) it leaves, of how much.

    Of a delay that nothing determines 1.5 ns are taken for known.
    """

    what: str
    mean_ns: float
    instead_of_ns: float


@dataclass(frozen=True, slots=True)
class Halves:
    """Half intervals in ns, infinite where undetermined: of a delay, of one against the mean of all, of that mean.

    Of delays the root mean square of all.
    """

    each: float
    apart: float
    common: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """A procedure in steps, and the interval (ns, half of 95 %) that each delay will have; infinite where none.

    `after_ns` has the intervals when only the first arrangement, the first two and so on are made. `verdict` says what
    the arrangements determine; `common_ns` is the half interval of what all delays share, to which every absolute
    distance owes as much; `with_curve_ns` has all intervals where a curve over power is fitted along, as surveys do
    unless they are told otherwise. Of all pairs a share `reflected` is taken to say nothing. `next_best` are the next
    arrangement and the next taped distance, the better one first. With `known_beside`, distances or places are known
    that a survey must be told.

    >>> import calib
    >>> plan = calib.plan(4, on="line", arrangements=6)
    >>> len(plan.arrangements), plan.undetermined
    (6, ())
    >>> print(plan.arrangements[0].order())
    (1, 2, 3, 4)
    """

    on: str
    tags: tuple[int, ...]
    arrangements: tuple[PlannedArrangement, ...]
    half_ns: Mapping[int, float]
    after_ns: tuple[Mapping[int, float], ...]
    common_ns: float
    with_curve_ns: Halves
    verdict: Verdict
    next_best: tuple[NextBest, ...]
    rate_hz: float
    seconds_each: float
    pair_error_m: float
    reflected: float
    known_beside: bool
    steps: tuple[str, ...]

    @property
    def undetermined(self) -> tuple[int, ...]:
        """The tags whose delay the arrangements leave open."""
        return tuple(int(tag) for tag in self.verdict.named("delay"))

    def __str__(self) -> str:
        """Return the steps, the pictures and the intervals."""
        return "\n".join([*self.steps, "", *self._intervals()])

    def _intervals(self) -> list[str]:
        share = f", and {100 * self.reflected:g} % of the pairs are reflected" if self.reflected else ""
        lines = [f"Promised, if the constant error of a pair is {100 * self.pair_error_m:.1f} cm{share}:"]
        for tag in self.tags:
            half = self.half_ns[tag]
            lines.append(f"  tag {tag:3d}  " + (f"± {half:.3f} ns (95 %)" if math.isfinite(half) else "undetermined"))
        if math.isfinite(self.common_ns):
            lines.append(f"  what all share ± {self.common_ns:.3f} ns")
        if self.undetermined:
            lines += [f"not determined: {direction.words}" for direction in self.verdict.free]
        lines.append(self._curved())
        for best in self.next_best:
            lines.append(f"next best: {best.what}: ± {best.mean_ns:.3f} ns on average, not {best.instead_of_ns:.3f}")
        return lines

    def _curved(self) -> str:
        curved = self.with_curve_ns
        said = [
            f"{what} ± {half:.3f} ns" if math.isfinite(half) else f"{what} undetermined"
            for what, half in (
                ("a delay", curved.each),
                ("one against their mean", curved.apart),
                ("what all share", curved.common),
            )
        ]
        return f"With a curve over power fitted along, as surveys do where powers vary: {', '.join(said)}."

    def to_dict(self) -> dict[str, Any]:
        """Return everything as JSON takes it; null where nothing is determined."""
        known = {str(tag): half if math.isfinite(half) else None for tag, half in self.half_ns.items()}
        return {
            "on": self.on,
            "rate_hz": self.rate_hz,
            "seconds_each": self.seconds_each,
            "pair_error_m": self.pair_error_m,
            "half_interval_ns": known,
            "common_ns": _number(self.common_ns),
            "with_curve_ns": {k: _number(getattr(self.with_curve_ns, k)) for k in ("each", "apart", "common")},
            "reflected": self.reflected,
            "undetermined": list(self.undetermined),
            "arrangements": [
                {"name": a.name, "place_m": {str(t): list(p) for t, p in a.place_m.items()}, "taped": list(a.taped)}
                for a in self.arrangements
            ],
            "next_best": [
                {"what": b.what, "mean_ns": b.mean_ns, "instead_of_ns": b.instead_of_ns} for b in self.next_best
            ],
            "steps": list(self.steps),
        }


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None
