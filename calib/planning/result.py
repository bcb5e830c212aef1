"""Plans: steps and commands, the expected interval of each delay, and the gain of one more measurement."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, Generic

import numpy as np

from calib.calibration.document import Value, for_json
from calib.information import Verdict
from calib.planning.settings import FlightPlanSettings
from uwblink.arrays import Floats


def mean_std_ns(information: Floats) -> float:
    """Return the root mean square standard error of delays, ns, from the information of data (tags, tags), 1/ns^2, and
    of a prior.

    The result is rounded, so that mirror images are equally good on every machine, and the first of them is chosen.
    """
    # The prior's standard deviation is 2.5 times the differences of published delays (0.6 ns); with it the mean is
    # finite even if some delays are not determined.
    whole = information + np.eye(len(information)) / 1.5**2
    return round(float(np.sqrt(np.trace(np.linalg.inv(whole)) / len(whole))), 8)


@dataclass(frozen=True, slots=True)
class PlannedArrangement:
    """An arrangement: its name, approximate positions of the boards (metres, by tag), and pairs whose distance is to be
    measured with a tape.
    """

    name: str
    place_m: Mapping[int, tuple[float, float, float]]
    taped: tuple[tuple[int, int], ...]

    def order(self) -> tuple[int, ...]:
        """Return the tags in the order in which they lie along x."""
        return tuple(sorted(self.place_m, key=lambda tag: self.place_m[tag]))

    def where(self, on: str) -> str:
        """Return in words where boards stand on a "line", a "plane", or in a room."""
        if on == "line":
            return "in the order " + " ".join(map(str, self.order()))
        axes = 2 if on == "plane" else 3
        spots = (f"{tag} at ({', '.join(f'{v:.1f}' for v in p[:axes])})" for tag, p in self.place_m.items())
        return f"with {', '.join(spots)}"


@dataclass(frozen=True, slots=True)
class NextBest:
    """An additional measurement, and the mean half intervals (ns) with it (`mean_ns`) and without it.

    An undetermined delay counts with a standard error of 1.5 ns.
    """

    what: str
    mean_ns: float
    instead_of_ns: float


@dataclass(frozen=True, slots=True)
class Precision(Generic[Value]):
    """Precision of delays in ns: of each, of each relative to the mean of all, and of that mean; infinite if
    undetermined.

    The values are standard deviations or half intervals; those of delays are arrays (tags,) or root mean squares.
    """

    each: Value
    apart: Value
    common: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _Plan:
    """The base of both kinds of plans: half 95 % intervals of the delays (ns), infinite for undetermined ones.

    `open_ns` are half intervals that can include those of undetermined delays. `common_ns` is the half interval of the
    mean of all delays, which is an error of every absolute distance. `verdict` states which delays are determined,
    `next_best` the gains of single additional measurements, the best one first.
    """

    half_ns: Mapping[int, float]
    common_ns: float
    verdict: Verdict
    next_best: tuple[NextBest, ...]
    reflected: float
    open_ns: Mapping[int, float] = field(default_factory=dict)

    @property
    def undetermined(self) -> tuple[int, ...]:
        """The tags whose delay is not determined."""
        return tuple(int(tag) for tag in self.verdict.named("delay"))

    @property
    def steps(self) -> tuple[str, ...]:
        """The steps of the plan, one line each."""
        return tuple(f"{k}. {step}" for k, step in enumerate(self._steps(), start=1))

    def _steps(self) -> list[str]:
        raise NotImplementedError

    def _expectation(self) -> tuple[str, list[str]]:
        """Return the assumed errors in words, and lines on the common part of the delays."""
        raise NotImplementedError

    def __str__(self) -> str:
        """Return the steps and the intervals."""
        assumed, shared = self._expectation()
        wide = {tag: f"undetermined (± {half:.2f} ns)" for tag, half in self.open_ns.items()}
        lines = [
            *self.steps,
            "",
            f"Expected accuracy, if {assumed}:",
            *(
                f"  tag {tag:3d}  "
                + (f"± {half:.3f} ns (95 %)" if math.isfinite(half) else wide.get(tag, "undetermined"))
                for tag, half in self.half_ns.items()
            ),
            *shared,
            *(f"not determined: {words}" for words in self.verdict.free if self.undetermined),
            *(
                f"{'or' if k else 'next best'}: {best.what}: ± {best.mean_ns:.3f} ns on average, not "
                f"{best.instead_of_ns:.3f}"
                for k, best in enumerate(self.next_best)
            ),
        ]
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return all fields for JSON; undetermined values are null."""
        return {
            "half_interval_ns": for_json(self.half_ns),
            "common_ns": for_json(self.common_ns),
            "undetermined": list(self.undetermined),
            "reflected": self.reflected,
            "next_best": [asdict(best) for best in self.next_best],
            "steps": list(self.steps),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan(_Plan):
    """A plan for `survey`: arrangements of boards that stand still.

    `after_ns` are the intervals after the first arrangement, the first two and so on; `with_curve_ns` are the intervals
    with a curve over power, which surveys fit by default. A share `reflected` of all pairs has no information. With
    `known_beside`, the survey needs a file of known distances or positions.

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
    after_ns: tuple[Mapping[int, float], ...]
    with_curve_ns: Precision[float]
    rate_hz: float
    seconds_each: float
    pair_error_m: float
    known_beside: bool

    def _steps(self) -> list[str]:
        held = {"line": "Stretch a string and keep it straight", "plane": "Take a flat table or floor"}
        first = (
            f"{held.get(self.on, 'Use the room')}. The positions are only proposals, but the order matters; measure "
            f"only the distances named below."
        )
        shape = f", known to be on a {self.on}" if self.on else ""
        beside = " Write the other known facts into a file: measured distances, positions of anchors."
        made = [
            f"Arrangement {one.name}: boards {one.where(self.on)}."
            + "".join(f" Measure the distance of {i} and {j} with a tape, antenna to antenna." for i, j in one.taped)
            + f" Record all pairs as arrangement {one.name} for {self.seconds_each:.0f} s."
            for one in self.arrangements
        ]
        return [first, *made, f"Survey all recordings together{shape}.{beside if self.known_beside else ''}"]

    def _expectation(self) -> tuple[str, list[str]]:
        share = f", and {100 * self.reflected:g} % of the pairs are reflected" if self.reflected else ""
        shared = [f"  common part ± {self.common_ns:.3f} ns"] if math.isfinite(self.common_ns) else []
        halves = zip(
            ("a delay", "each relative to the mean", "the common part"),
            asdict(self.with_curve_ns).values(),
            strict=True,
        )
        curved = ", ".join(
            f"{what} ± {half:.3f} ns" if math.isfinite(half) else f"{what} undetermined" for what, half in halves
        )
        shared.append(f"If a curve over power is fitted as well, as surveys do if powers vary: {curved}.")
        return f"the constant error of a pair is {100 * self.pair_error_m:.1f} cm{share}", shared

    def commands(self, ports: str) -> Iterator[str]:
        """Yield the commands of the plan; `ports` are the boards' serial ports."""
        for one in self.arrangements:
            order = f" --order {','.join(map(str, one.order()))}" if self.on == "line" else ""
            shape = f" --known {self.on}{order}" if self.on else ""
            words = f"--pairs all --rate {self.rate_hz:g} --duration {self.seconds_each:.0f} -o {one.name}.uwb"
            yield f"uwblink record {ports} --arrangement {one.name}{shape} {words}"
        beside = " --known known.toml" if self.known_beside else ""
        yield f"calib survey {' '.join(f'{one.name}.uwb' for one in self.arrangements)}{beside} -o calibration.json"

    def to_dict(self) -> dict[str, Any]:
        """Return all fields for JSON; undetermined values are null."""
        return _Plan.to_dict(self) | {
            "on": self.on,
            "rate_hz": self.rate_hz,
            "seconds_each": self.seconds_each,
            "pair_error_m": self.pair_error_m,
            "with_curve_ns": for_json(asdict(self.with_curve_ns)),
            "arrangements": [
                {"name": a.name, "place_m": {str(t): list(p) for t, p in a.place_m.items()}, "taped": list(a.taped)}
                for a in self.arrangements
            ],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan(_Plan):
    """A plan of a flight.

    `open_ns` has all delays. `common_ns` is the half interval of their mean, `apart_ns` that of each relative to the
    mean; both are for the determined delays, or for all if none is determined. `path_m` (k, bodies, 3) are positions of
    the moving `bodies`, `stands` those of the others.

    >>> import calib
    >>> plan = calib.plan_flight(2, seconds=20.0, poses_until_s=0.0, anchors=[11, 12, 13, 14])
    >>> sorted(plan.half_ns)
    [1, 2, 3, 4, 11, 12, 13, 14]
    """

    settings: FlightPlanSettings
    ranges: int
    seconds: float
    source: str
    apart_ns: float
    taped: tuple[tuple[int, int], ...]
    path_m: Floats
    stands: Mapping[str, Floats]
    bodies: tuple[str, ...]

    def _steps(self) -> list[str]:
        flown, robots = self.settings, self.settings.robots or ()
        bodies = ", ".join(f"{' and '.join(map(str, tags))} on robot {k}" for k, tags in enumerate(robots, start=1))
        room = " x ".join(f"{v:g}" for v in flown.size_m)
        known = "are measured" if flown.anchor_places == "given" else "are found along"
        standing = f", while the robots stand still for the first {flown.still_s:g} s" if flown.still_s else ""
        steps = [
            (not robots, f"Fly as in {self.source}: {self.ranges} ranges in {self.seconds:.0f} s."),
            (robots, f"Measure the position of each tag on its body to a centimetre: tags {bodies}."),
            (flown.anchors, f"Fix anchors {', '.join(map(str, flown.anchors))} around the room, high and low in turn."),
            (
                robots,
                f"Fly for {self.seconds:.0f} s in a room of {room} m at about {flown.speed_m_s:g} m/s, and turn left "
                f"and right; all pairs of tags on different robots range in turn, {flown.rate_hz:g} exchanges per "
                f"second in total.",
            ),
            (
                flown.poses_until_s,
                f"All positions must be known to about 2 cm for the first {flown.poses_until_s or 0:g} s.",
            ),
            (self.stands, f"The positions of the {len(self.stands)} anchors {known}."),
            *(
                (True, f"Measure the distance of tags {a} and {b} with a tape, antenna to antenna{standing}.")
                for a, b in self.taped
            ),
            (flown.attitudes == "imu", "Attitudes come from gyroscopes and accelerometers."),
            (
                flown.attitudes == "poses",
                f"Attitudes must be known all the time, with headings to {flown.heading_std_deg:g} degrees.",
            ),
            (True, "Fit delays, curve and trajectories together."),
        ]
        return [text for needed, text in steps if needed]

    def _expectation(self) -> tuple[str, list[str]]:
        which = "" if len(self.undetermined) in (0, len(self.half_ns)) else " of those that are determined"
        assumed = f"ranges have {100 * self.settings.noise_m:.1f} cm of noise and {100 * self.reflected:.0f} % are"
        shared = f"  common part{which} ± {self.common_ns:.3f} ns, each relative to the mean ± {self.apart_ns:.3f} ns"
        return f"{assumed} reflected", [shared]

    def commands(self, ports: str, recording: str = "") -> Iterator[str]:
        """Yield the commands of the plan; those of recording are left out for a plan from a `recording`."""
        name, flown = recording or self.source, self.settings
        if flown.robots is not None:
            name = "flight.uwb"
            yield f"uwblink record {ports} --pairs all --duration {self.seconds:.0f} -o {name}"
            yield f"uwblink poses {name} --from poses.csv --tags robots.toml"
        until = flown.poses_until_s
        when = f"@0..{flown.still_s:g}" if flown.still_s else ""
        options = [
            ("" if until is None else f"--poses-until {until:g}", until is not None),
            (f"--attitudes {flown.attitudes}", flown.attitudes != "poses"),
            (f"--heading-std {flown.heading_std_deg:g}", flown.heading_std_deg != 3),
            (f"--anchors {flown.anchor_places}", bool(self.stands)),
            *((f"--distance {first}-{second}=METRES{when}", True) for first, second in self.taped),
        ]
        words = [option for option, needed in options if needed]
        yield f"calib fit {name} --truth ranges {' '.join(words)} -o calibration.json"

    def to_dict(self) -> dict[str, Any]:
        """Return all fields but the path for JSON; undetermined values are null."""
        return _Plan.to_dict(self) | {
            "on": "flight",
            "ranges": self.ranges,
            "seconds": self.seconds,
            "noise_m": self.settings.noise_m,
            "taped": [list(pair) for pair in self.taped],
            "half_interval_all_ns": for_json(self.open_ns),
            "apart_ns": self.apart_ns,
        }
