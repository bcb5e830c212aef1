"""The plan of a flight: steps, the interval that each delay will have, and what one more measurement would bring."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from calib.information import Verdict
from calib.planning.reference_motion import FlightInputs
from calib.planning.result import NextBest
from calib.trajectories.scene import Usable
from uwblink.arrays import Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """How a flight will be fitted, and the interval (ns, half of 95 %) of each delay; infinite where undetermined.

    `open_ns` are the intervals of all, determined or not; `common_ns` is that of what all delays share, `apart_ns` that
    of a delay against the mean of all: both of the determined ones, or of all where none is. `next_best` is what one
    measurement more would bring, the best first. `taped` are pairs of tags whose distance is to be measured, of anchors
    or of robots while they stand for the first `still_s`. `flown` is how robots fly, None where a recording says so.
    `path_m` (k, bodies, 3) is where the moving `bodies` are, `stands` where others stand.

    >>> import calib
    >>> plan = calib.plan_flight(2, seconds=20.0, poses_until_s=0.0, anchors=[11, 12, 13, 14])
    >>> sorted(plan.half_ns)
    [1, 2, 3, 4, 11, 12, 13, 14]
    """

    flown: FlightInputs | None
    usable: Usable
    imu: str | None
    noise_m: float
    reflected: float
    ranges: int
    seconds: float
    source: str
    half_ns: Mapping[int, float]
    open_ns: Mapping[int, float]
    common_ns: float
    apart_ns: float
    verdict: Verdict
    next_best: tuple[NextBest, ...]
    taped: tuple[tuple[int, int], ...]
    still_s: float
    path_m: Floats
    stands: Mapping[str, Floats]
    bodies: tuple[str, ...]

    @property
    def undetermined(self) -> tuple[int, ...]:
        """The tags whose delay the ranges leave open."""
        return tuple(int(tag) for tag in self.verdict.named("delay"))

    @property
    def steps(self) -> tuple[str, ...]:
        """What to do, a line each."""
        return tuple(f"{k}. {step}" for k, step in enumerate(self._steps(), start=1))

    def __str__(self) -> str:
        """Return the steps and the intervals."""
        return "\n".join([*self.steps, "", *self._intervals()])

    def _steps(self) -> Iterator[str]:
        flown = self.flown
        if flown is None:
            yield f"Fly as {self.source} does: {self.ranges} ranges in {self.seconds:.0f} s."
        else:
            robots = ", ".join(
                f"{' and '.join(map(str, tags))} on robot {k}" for k, tags in enumerate(flown.robots, start=1)
            )
            yield f"Note where on its body each tag sits, to a centimetre: tags {robots}."
            if flown.anchors:
                yield f"Fix anchors {', '.join(map(str, flown.anchors))} around the room, high and low in turn."
            room = " x ".join(f"{v:g}" for v in flown.size_m)
            yield (
                f"Fly for {self.seconds:.0f} s about a room of {room} m at about {flown.speed_m_s:g} m/s, turning to "
                f"and fro; every pair of different robots ranges in turn, {flown.rate_hz:g} exchanges a second in all."
            )
        yield from self._known()
        yield "Fit delays, curve and trajectories together."

    def _known(self) -> Iterator[str]:
        if self.usable.poses_until_s:
            yield f"Let all positions be known for the first {self.usable.poses_until_s:g} s, to about 2 cm."
        if self.stands:
            given = self.usable.anchors == "given"
            yield f"Places of the {len(self.stands)} anchors {'are measured' if given else 'are found along'}."
        for first, second in self.taped:
            yield f"Tape the distance of tags {first} and {second}, antenna to antenna{self._while()}."
        if self.usable.attitudes == "imu":
            yield "Attitudes come from gyroscopes and accelerometers."
        elif self.usable.attitudes == "poses":
            yield f"Attitudes come all along, with headings good to {self.usable.heading_std_deg:g} degrees."

    def _while(self) -> str:
        return f", while robots stand for the first {self.still_s:g} s" if self.still_s else ""

    def _intervals(self) -> Iterator[str]:
        percent = 100 * self.reflected
        yield f"Promised, if ranges have {100 * self.noise_m:.1f} cm of noise and {percent:.0f} % are reflected:"
        for tag, half in self.half_ns.items():
            known = f"± {half:.3f} ns (95 %)" if math.isfinite(half) else f"undetermined (± {self.open_ns[tag]:.2f} ns)"
            yield f"  tag {tag:3d}  {known}"
        which = "" if len(self.undetermined) in (0, len(self.half_ns)) else " of those that are determined"
        yield f"  what all share{which} ± {self.common_ns:.3f} ns, each against the mean ± {self.apart_ns:.3f} ns"
        if self.undetermined:
            yield from (f"not determined: {direction.words}" for direction in self.verdict.free)
        for k, best in enumerate(self.next_best):
            first = "next best" if k == 0 else "or"
            yield f"{first}: {best.what}: ± {best.mean_ns:.3f} ns on average, not {best.instead_of_ns:.3f}"

    def to_dict(self) -> dict[str, Any]:
        """Return everything but the path as JSON takes it; null where nothing is determined."""
        known = {str(tag): half if math.isfinite(half) else None for tag, half in self.half_ns.items()}
        return {
            "on": "flight",
            "ranges": self.ranges,
            "seconds": self.seconds,
            "noise_m": self.noise_m,
            "reflected": self.reflected,
            "taped": [list(pair) for pair in self.taped],
            "half_interval_ns": known,
            "half_interval_all_ns": {str(tag): half for tag, half in self.open_ns.items()},
            "common_ns": self.common_ns,
            "apart_ns": self.apart_ns,
            "undetermined": list(self.undetermined),
            "next_best": [
                {"what": b.what, "mean_ns": b.mean_ns, "instead_of_ns": b.instead_of_ns} for b in self.next_best
            ],
            "steps": list(self.steps),
        }
