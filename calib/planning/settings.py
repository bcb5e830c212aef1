"""The settings of plans, for Python and for the command line, and their checks."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from calib.errors import BadInputError
from calib.settings import CheckedSettings, are_tags, check_choice, refuse
from uwblink.display import first_few
from uwblink.settings import setting
from uwblink.text_files import is_number

ROOMS_M: Final = {"line": (5.0,), "plane": (3.0, 2.0), "space": (6.0, 5.0, 2.5)}
"""Default lengths of the places for boards: a string across a room, a large table, a room."""

IMU_GRADES: Final = ("consumer", "industrial", "tactical")
"""Grades of IMUs, whose noise is that of data sheets (`calib.evaluation.IMUS`)."""


def read_numbers(text: str, parameter: str | None = None) -> list[float]:
    """Return numbers from a text with commas; raises `BadInputError` that names the `parameter`."""
    try:
        return [float(part) for part in text.split(",")] if text.strip() else []
    except ValueError:
        raise BadInputError(f"found {text!r:.40}, expected numbers with commas", parameter=parameter) from None


def read_whole(text: str, parameter: str | None = None) -> list[int]:
    """Return ids or a count from a text with commas; raises `BadInputError` that names the `parameter`."""
    found = read_numbers(text, parameter)
    if not found or not all(math.isfinite(value) and value == int(value) for value in found):
        raise BadInputError(f"found {text!r:.40}, expected whole numbers with commas", parameter=parameter)
    return [int(value) for value in found]


def _are_lengths(size_m: object, dimensions: int) -> bool:
    sides = list(size_m) if isinstance(size_m, Iterable) else []
    return len(sides) == dimensions and all(is_number(side) and 0 < side <= 1000 for side in sides)


OF_BOTH: Final[dict[str, Any]] = {
    "size_m": {"flag": "--size", "kind": str | None, "parse": read_numbers, "metavar": "M,M,M"},
    "anchors": {
        "help": "Boards at known, fixed positions.",
        "flag": "--anchor-tags",
        "kind": str | None,
        "parse": read_whole,
        "metavar": "TAG,TAG...",
    },
    "rate_hz": {"help": "Exchanges per second, all pairs together (Hz).", "flag": "--rate"},
    "taped": {"help": "Number of distances that will be measured with a tape."},
    "tape_sigma_m": {"help": "Standard deviation of a distance by tape (m).", "flag": "--tape-sigma"},
}
"""The options of settings that plans of both kinds have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveyPlanSettings(CheckedSettings):
    """Settings of `calib.plan`, which also takes them as keyword arguments; raises `BadInputError`.

    `on` is "line" (a string), "plane" (a table) or "space" (a room), of `size_m` (up to three lengths). `taped` is the
    number of distances that will be measured, with a standard deviation of `tape_sigma_m`; `anchors` are boards at
    fixed positions that are known to `anchor_sigma_m`. If `arrangements` is None, arrangements are added while they
    improve the accuracy, up to 12. `pair_error_m` is the constant error of a pair in an arrangement, `reflected` the
    share of reflected pairs, which have no information. `tags` are the boards; `plan` sets them.

    >>> import calib
    >>> settings = calib.SurveyPlanSettings(on="plane", size_m=(3.0, 2.0), arrangements=2)
    >>> len(calib.plan(5, settings).arrangements)
    2
    """

    tags: tuple[int, ...] = ()
    on: str = setting(
        "line",
        "Where the boards stand: on a string (line), on a table (plane), or in a room (space).",
        names=tuple(ROOMS_M),
    )
    arrangements: int | None = setting(
        None, "Number of arrangements; by default as many as improve the accuracy.", bounds=(1, 26)
    )
    size_m: Sequence[float] | None = setting(
        None, "Length of the line, or sides of plane or room (m).", **OF_BOTH["size_m"]
    )
    taped: int = setting(0, **OF_BOTH["taped"], bounds=(0, 1000))
    tape_sigma_m: float = setting(0.005, **OF_BOTH["tape_sigma_m"], bounds=(1e-9, 100.0))
    anchors: Sequence[int] = setting((), **OF_BOTH["anchors"])
    anchor_sigma_m: float = setting(
        0.01, "Standard deviation of known positions (m).", flag="--anchor-sigma", bounds=(1e-9, 100.0)
    )
    pair_error_m: float = setting(
        0.02, "Constant error of a pair in an arrangement (m).", flag="--pair-error", bounds=(1e-9, 100.0)
    )
    # With a larger share a survey could not tell which pairs are reflected.
    reflected: float = setting(0.0, "Share of pairs that are reflected.", bounds=(0.0, 0.3))
    rate_hz: float = setting(50.0, **OF_BOTH["rate_hz"], bounds=(1e-3, 1e5))
    seed: int = 1

    def __post_init__(self) -> None:
        """Check all values."""
        CheckedSettings.__post_init__(self)
        tags = self.tags
        on_line = "anchors need a plane or space; on a line give the number of measured distances"
        wrong_size = self.size_m is not None and not _are_lengths(self.size_m, self.dimensions)
        several = 2 <= len(tags) <= 30 and len(set(tags)) == len(tags)
        strangers = [tag for tag in self.anchors if tags and tag not in tags]
        refuse(
            [
                (
                    "boards",
                    tags and not several,
                    f"found {first_few(map(str, tags))}, expected 2 to 30 boards, each once",
                ),
                ("anchors", strangers, f"{min(strangers, default=0)} is none of the boards"),
                (
                    "anchors",
                    len(set(self.anchors)) < len(self.anchors),
                    f"found {self.anchors}, expected each board once",
                ),
                ("anchors", self.anchors and self.on == "line", on_line),
                (
                    "size_m",
                    wrong_size,
                    f"found {self.size_m}, expected as many lengths in metres as dimensions, {self.dimensions}",
                ),
            ]
        )

    @property
    def dimensions(self) -> int:
        """The number of dimensions of the boards' positions."""
        return len(ROOMS_M[self.on])


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlanSettings(CheckedSettings):
    """Settings of `calib.plan_flight`, which also takes them as keyword arguments; raises `BadInputError`.

    Without a recording, robots fly for `seconds` in a room of `size_m` at about `speed_m_s`; the tags of a robot are
    `apart_m` from each other. All pairs of tags on different robots and `anchors` (ids of tags at the walls) range in
    turn, `rate_hz` times per second in total, but not two anchors. Robots stand still for the first `still_s`.

    Positions are known for the first `poses_until_s` (None: always). `attitudes` come from "poses" (an attitude
    reference), from the "imu", or are unknown ("none"); `imu` is its grade. `anchor_places` are "given" or "sought".
    `taped` is the number of distances that are measured to `tape_sigma_m`, at the best places: between tags of robots
    that stand still, or between anchors at unknown positions. Ranges have a noise of `noise_m`, and a share `reflected`
    is longer by 0.3 m on average. `robots` are the tags of each robot; `plan_flight` sets them.

    >>> import calib
    >>> settings = calib.FlightPlanSettings(seconds=10.0, rate_hz=40.0)
    >>> calib.plan_flight(3, settings).undetermined
    ()
    """

    robots: Any = None
    seconds: float = setting(60.0, "Duration in seconds.", flag="--duration", bounds=(5.0, 3600.0))
    rate_hz: float = setting(80.0, **OF_BOTH["rate_hz"], bounds=(0.5, 2000.0))
    size_m: Sequence[float] = setting((6.0, 5.0, 2.5), "Sides of the room (m).", **OF_BOTH["size_m"])
    speed_m_s: float = setting(1.0, "Mean speed of the robots (m/s).", flag="--robot-speed", bounds=(0.05, 10.0))
    apart_m: float = setting(0.5, "Distance between the tags of a robot (m).", flag="--tag-spacing", bounds=(0.0, 3.0))
    poses_until_s: float | None = setting(
        10.0, "Time from the start for which positions are known.", flag="--poses-until", metavar="SECONDS"
    )
    attitudes: str = setting(
        "poses",
        "Source of attitudes: poses (an attitude reference), the IMU, or none.",
        names=("poses", "imu", "none"),
    )
    heading_std_deg: float = setting(
        3.0, "Standard deviation of headings; 0: headings are exact.", flag="--heading-std", metavar="DEGREES"
    )
    imu: str | None = setting(None, "Grade of the robots' inertial sensors.", names=IMU_GRADES)
    anchors: Sequence[int] = setting((), **OF_BOTH["anchors"])
    anchor_places: str = setting(
        "given", "Positions of anchors: given, or sought (estimated).", flag="--anchors", names=("given", "sought")
    )
    still_s: float = setting(
        0.0,
        "Time for which the robots stand still at the start, for measured distances.",
        flag="--standstill",
        metavar="SECONDS",
        bounds=(0.0, 600.0),
    )
    taped: int = setting(0, **OF_BOTH["taped"], bounds=(0, 10))
    tape_sigma_m: float = setting(0.01, **OF_BOTH["tape_sigma_m"], bounds=(1e-4, 1.0))
    noise_m: float = setting(0.04, "Noise of a range (m).", flag="--range-noise", bounds=(1e-4, 10.0))
    reflected: float = setting(0.08, "Share of ranges that are reflected.", bounds=(0.0, 0.9))
    delays_only: bool = setting(False, "Plan for a fit without a curve over power.")
    seed: int = 1

    def __post_init__(self) -> None:
        """Check all values, and those of the robots if there are any."""
        CheckedSettings.__post_init__(self)
        if self.imu is not None:
            check_choice("imu", self.imu, IMU_GRADES)
        asked, known = self.robots, self.robots is not None
        listed = [(2 * k + 1, 2 * k + 2) for k in range(asked)] if isinstance(asked, int) else asked or ()
        if not isinstance(listed, Iterable) or isinstance(listed, str) or not all(map(are_tags, listed)):
            raise BadInputError(f"found {asked!r:.60}, expected the ids of the tags of each robot", parameter="robots")
        robots = tuple(tuple(map(int, tags)) for tags in listed)
        tags, anchors, ranges = [tag for robot in robots for tag in robot], self.anchors, self.seconds * self.rate_hz
        # A mistyped number must not exhaust the memory: 60 tags are 1770 pairs, 200 000 ranges are five flights.
        most_tags, most_ranges = 60, 200_000
        once = len(set(tags)) == len(tags) and len(tags) + len(anchors) <= most_tags
        among = (
            f"found {self.robots!r:.60}, expected robots with a tag or more each, every tag once, at most {most_tags}"
        )
        others = len(set(anchors)) == len(anchors) and not set(anchors) & set(tags)
        refuse(
            [
                ("size_m", not _are_lengths(self.size_m, 3), f"found {self.size_m}, expected three lengths in metres"),
                (
                    "seconds",
                    known and ranges > most_ranges,
                    f"{ranges:.0f} ranges are too many for a plan; at most {most_ranges} are allowed",
                ),
                (
                    "still_s",
                    known and self.still_s > self.seconds / 2,
                    f"found {self.still_s}, expected at most half of the {self.seconds:g} s",
                ),
                ("robots", known and not (robots and all(robots) and once), among),
                ("anchors", not others, f"found {anchors}, expected other tags than those of robots"),
                (
                    "robots",
                    len(robots) == 1 and not anchors,
                    "a single robot without anchors has no partner for ranges",
                ),
                (
                    "robots",
                    not all(0 < tag < 65536 for tag in (*tags, *anchors)),
                    f"found {first_few(map(str, (*tags, *anchors)))}, expected ids of 1 to 65535",
                ),
            ]
        )
        object.__setattr__(self, "robots", robots if known else None)

    @property
    def inertial(self) -> bool:
        """Whether robots have an IMU."""
        return self.imu is not None or self.attitudes == "imu"
