"""Settings of fits, for Python and the command line, and their checks."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from calib.errors import BadInputError
from uwblink.settings import setting
from uwblink.text_files import TomlReader, is_number, number_in

if TYPE_CHECKING:
    from uwblink import KnownDistance

POSITIVE: Final = sys.float_info.min
ABOVE_ZERO: Final = (POSITIVE, math.inf, "a number above 0")
NUMBERS: Final = {
    "scale_ns": (POSITIVE, math.inf, "a positive number of ns"),
    "between_m": (0.0, math.nextafter(1.0, 0.0), "metres, 0 to 1"),
    "alpha_dbm": (-math.inf, math.inf, "a power in dBm"),
    "reference_power_dbm": (-200.0, 0.0, "a power in dBm, -200 to 0"),
    "hold_out": (0.0, 0.9, "a share, 0 to 0.9"),
    "poses_until_s": (0.0, math.inf, "a number of 0 or more"),
    "heading_std_deg": (0.0, math.inf, "a number of 0 or more"),
    "pair_error_m": (1e-9, 100.0, "metres, 1e-9 to 100"),
    **dict.fromkeys(("velocity_std_mps", "velocity_rate_hz", "initial_std_m", "gate", "reopen_s"), ABOVE_ZERO),
    **dict.fromkeys(("start_std_m", "start_std_deg", "start_std_m_s", "rate_hz", "speed_m_s"), ABOVE_ZERO),
    "seeds": (1, 1000, "1 to 1000"),
    "seed": (0, math.inf, "a whole number of 0 or more"),
}
"""Smallest and largest value of settings without `bounds` in their metadata, and the expected value in words."""

FIXED: Any = {
    "help": "Known delay of a tag, which is not fitted, such as 1=-0.36. May be repeated.",
    "flag": "--fix",
    "kind": list[str] | None,
    "tags": "{}=",
    "metavar": "TAG=NS",
}
"""The option of known delays."""

ERRORS_PANEL: Final = "Error model"
MODEL_PANEL: Final = "Fitted model"
FLIGHT_PANEL: Final = "Without known distances (--truth ranges)"


def check_choice(parameter: str, value: str, allowed: Iterable[str]) -> None:
    """Raise `BadInputError` that lists the allowed values if `value` is not one of them."""
    if value not in allowed:
        raise BadInputError(f"found {value!r}, allowed: {', '.join(allowed)}", parameter=parameter)


def refuse(rows: Iterable[tuple[str, object, str]]) -> None:
    """Raise `BadInputError` for the first row that is wrong: the name of a parameter, whether it is, and the text."""
    for parameter, is_wrong, text in rows:
        if is_wrong:
            raise BadInputError(text, parameter=parameter)


def check_tag(tag: object) -> None:
    """Raise `BadInputError` unless a value can be the id of a tag."""
    if not is_tag(tag):
        raise BadInputError(f"found {tag!r}, expected the id of a tag, 0 to 65535", parameter="tag")


def are_tags(value: object) -> bool:
    """Return whether a value is a sequence of ids of tags."""
    return isinstance(value, Iterable) and not isinstance(value, str | bytes) and all(map(is_tag, value))


def is_tag(value: object) -> bool:
    """Return whether a value can be the id of a tag."""
    # Ids have 16 bits in recordings. `uwblink.twr.LARGEST_ID` is not used: importing it loads NumPy, too slow for help.
    return isinstance(value, Integral) and not isinstance(value, bool) and 0 <= int(value) < 2**16


def read_scale(text: str) -> float | None:
    """Return a scale in nanoseconds from a text, None for "auto"; raises `BadInputError` for other words."""
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError:
        raise BadInputError(f"found {text!r}, expected auto or a positive number of ns", parameter="scale_ns") from None


def read_fixed(texts: Iterable[str]) -> dict[int, float]:
    """Return known delays in ns by tag, from texts TAG=NS; raises `BadInputError` for other texts and repeated tags."""
    fixed: dict[int, float] = {}
    for text in texts:
        tag, equals, value = text.partition("=")
        delay = number_in(value)
        if not (equals and tag.strip().isdecimal() and math.isfinite(delay)):
            raise BadInputError(f"found {text!r}, expected TAG=NS, as in 1=-0.36", parameter="fixed_ns")
        if int(tag) in fixed:
            raise BadInputError(f"tag {int(tag)} has two known delays", parameter="fixed_ns")
        fixed[int(tag)] = delay
    return fixed


def read_groups(path: Path) -> dict[str, Any]:
    """Return the table `groups` of a TOML file, which maps names to lists of tags; `FitSettings` checks the lists.

    Raises `BadInputError` for a file with other content.
    """
    table = TomlReader(path, partial(BadInputError, parameter="groups")).table
    groups = table.get("groups")
    if not isinstance(groups, dict) or not groups or set(table) != {"groups"}:
        raise BadInputError(f"{path}: expected one table [groups], as in: monopole = [1, 2]", parameter="groups")
    return groups


@dataclass(frozen=True, slots=True)
class CheckedSettings:
    """Base of settings: checks their values, and lists those that differ from the defaults."""

    def __post_init__(self) -> None:
        """Check choices, numbers and known delays. A number is whole if its type is int, and may be None only if its
        type has None.

        If the default of a choice is None, other values than its names are accepted, such as a registered loss.
        """
        for one in fields(self):
            name, value, bounds = one.name, getattr(self, one.name), one.metadata.get("bounds")
            if one.metadata.get("names") and isinstance(one.default, str):
                check_choice(name, value, one.metadata["names"])
            stated = NUMBERS.get(name) if bounds is None else (*bounds, "{:g} to {:g}".format(*bounds))
            if stated and (value is not None or "None" not in str(one.type)):
                least, most, expected = stated
                fits = isinstance(value, Integral) or "int" not in str(one.type)
                if not (fits and is_number(value) and least <= value <= most):
                    raise BadInputError(f"found {value!r}, expected {expected}", parameter=name)
            if one.type == "Sequence[int]" and not are_tags(value):
                raise BadInputError(f"found {value!r:.60}, expected ids of tags, 0 to 65535", parameter=name)
            if name == "fixed_ns":
                refuse(
                    (
                        name,
                        not (is_tag(tag) and is_number(delay)),
                        f"found {tag!r}: {delay!r}, expected a tag id and its delay in ns",
                    )
                    for tag, delay in (value or {}).items()
                )
                object.__setattr__(self, name, {int(tag): float(delay) for tag, delay in (value or {}).items()})

    def changed(self) -> dict[str, Any]:
        """Return the settings that differ from the defaults, as JSON values for calibrations and reports."""
        given = {one.name: getattr(self, one.name) for one in fields(self)}
        default = type(self)()
        return {name: _as_json(value) for name, value in given.items() if value != getattr(default, name)}


def _as_json(value: object) -> object:
    """Return the value of a setting as a JSON value; objects are replaced by a description."""
    if isinstance(value, Mapping):
        return {str(key): _as_json(one) for key, one in value.items()}
    if isinstance(value, tuple):
        return list(value)
    objects = {"Calibration": "a calibration", "Knowledge": "known facts"}
    return value if isinstance(value, str | int | float) else objects.get(type(value).__name__, str(value))


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSettings(CheckedSettings):
    """Settings of `fit`, which also takes them as keyword arguments; raises `BadInputError` that names the setting.

    `loss` is "mixture", the likelihood of direct ranges, reflections and outliers with a share of reflections by pair,
    or a robust loss of residuals: "cauchy", "huber", "soft_l1", "l2", one that `register_loss` added; None chooses the
    mixture, and "cauchy" for a sequential fit and for one without a curve. `scale_ns` is the scale of a robust
    loss in time of flight, None to estimate it. `between_m` is the standard deviation of errors that are constant for
    a pair during a recording and differ between recordings; None estimates it from several recordings, and from one
    recording assumes 5 cm, or more if its eighths differ by more. `lift` and `alpha_dbm` define the lifted power of an
    exchange.

    `fixed_ns` are known delays by tag; `groups` are tags that share curves, by name (all do by default); `sequential`
    fits delays first and then the curve to the residuals (ICRA 2023, sections III and IV). The curve is zero at
    `reference_power_dbm`, `alpha_dbm` by default; `delays_only` fits no curve; `delays_from` is a calibration, or its
    path, whose delays are used and not fitted; `constants` "pair" gives each pair a constant instead of each tag a
    delay. `use` "receptions" also fits the frames that third tags overheard, which determine the delay of each target
    separately. `pattern` is the dependence of delays on direction: "shared" by all tags on bodies that turn, one for
    each "tag", "none", or "auto", which takes a model if the odds for it are 100 to 1. `temperature` is the dependence
    of ranges on the temperatures that tags measure, with the same choices. `hold_out` is the share of ranges, selected
    by `fold`, on which a second fit to the other ranges is evaluated; the result is in the provenance of the
    calibration, which is fitted to all ranges.

    >>> import calib
    >>> settings = calib.FitSettings(loss="huber", fixed_ns={1: -0.3})
    >>> calib.fit(calib.sample_flight(), settings).calibration.delays_ns[1]
    -0.3
    """

    loss: str | None = setting(
        None,
        "Likelihood or loss that is fitted. mixture (the default): reflections by pair; cauchy: for --sequential and "
        "--delays-only; l2: least squares; or a registered loss.",
        names=("mixture", "cauchy", "huber", "soft_l1", "l2"),
        rich_help_panel=ERRORS_PANEL,
    )
    scale_ns: float | None = setting(
        None,
        "Scale of a robust loss in ns of time of flight: larger errors get less weight. auto: estimated from the data.",
        flag="--scale",
        kind=str | None,
        parse=read_scale,
        metavar="NS|auto",
        rich_help_panel=ERRORS_PANEL,
    )
    between_m: float | None = setting(
        None,
        "Standard deviation (m) of a pair's mean error between recordings; by default estimated from several "
        "recordings, or 0.05 with one. Use 0 if nothing changes, as in simulated worlds.",
        flag="--between",
        metavar="M",
        rich_help_panel=ERRORS_PANEL,
    )
    lift: str = setting(
        "mean-of-lifted",
        "Lifted power of an exchange from the powers of its two ends.",
        names=("mean-of-lifted", "lift-of-mean"),
        rich_help_panel=MODEL_PANEL,
    )
    alpha_dbm: float = -82.0
    fixed_ns: Mapping[int, float] = setting(
        {},
        parse=read_fixed,
        rich_help_panel=MODEL_PANEL,
        **FIXED,
    )
    groups: Mapping[str, tuple[int, ...]] = setting(
        {},
        "Groups of tags that share curves (.toml with a table \\[groups]); by default all tags share them.",
        flag="--group",
        kind=Path | None,
        parse=read_groups,
        rich_help_panel=MODEL_PANEL,
    )
    sequential: bool = setting(
        False,
        "Fit the delays first, and then the curve to the residuals (ICRA 2023).",
        rich_help_panel=MODEL_PANEL,
    )
    reference_power_dbm: float | None = setting(
        None,
        "Power in dBm at which the curve is zero, so that ranges at this power need only the delays (default: -82, "
        "the published alpha).",
        flag="--reference-power",
        rich_help_panel=MODEL_PANEL,
    )
    delays_only: bool = setting(
        False,
        "Fit no curve over power. Use it if the ranges have no power, or if their power depends only on distance.",
        rich_help_panel=MODEL_PANEL,
    )
    delays_from: Any = setting(  # a Calibration or its path
        None,
        "Calibration whose delays are used and not fitted (.json). If it has the delays of all tags, only the curve "
        "is fitted.",
        kind=Path | None,
        rich_help_panel=MODEL_PANEL,
    )
    constants: str = setting(
        "tag",
        "Constant errors to fit: one of each tag (its antenna delay), or one of each pair.",
        names=("tag", "pair"),
        rich_help_panel=MODEL_PANEL,
    )
    use: str = setting(
        "exchanges",
        "Data to fit. exchanges: stamps of the two tags that range; receptions: also the stamps of tags that "
        "overheard them.",
        names=("exchanges", "receptions"),
        rich_help_panel=MODEL_PANEL,
    )
    pattern: str = setting(
        "auto",
        "Dependence of delays on direction. none: none; shared: one pattern for all tags on bodies that turn; tag: a "
        "pattern for each of these tags; auto: the model that the data support.",
        names=("auto", "none", "shared", "tag"),
        rich_help_panel=MODEL_PANEL,
    )
    temperature: str = setting(
        "auto",
        "Dependence of ranges on the temperatures that tags measure. none: none; shared: one slope for all tags; "
        "tag: a slope for each tag; auto: the model that the data support.",
        names=("auto", "none", "shared", "tag"),
        rich_help_panel=MODEL_PANEL,
    )
    hold_out: float = setting(
        0.0,
        "Share of the data to hold out, such as 0.3; a second fit, to the other data, is evaluated on it.",
        metavar="SHARE",
        rich_help_panel=MODEL_PANEL,
    )
    fold: str = setting(
        "time",
        "Parts that are held out: tenths of each session's time, pairs, or sessions.",
        names=("time", "pair", "session"),
        rich_help_panel=MODEL_PANEL,
    )

    def __post_init__(self) -> None:
        """Check the settings, except the name of the loss, which the fit checks."""
        CheckedSettings.__post_init__(self)
        beside = self.excludes_patterns
        refuse(
            [
                (
                    "fold",
                    self.fold != "time" and not self.hold_out,
                    f"{self.fold} has no effect without `hold_out`; set the share to hold out",
                ),
                (
                    "sequential",
                    self.sequential and self.loss == "mixture",
                    "a sequential fit needs a robust loss, not the mixture; remove one of the two settings",
                ),
                (
                    "scale_ns",
                    self.scale_ns is not None and self.fitted_loss == "mixture",
                    "a scale has no effect on the mixture; choose a robust loss, such as cauchy",
                ),
                ("groups", self.delays_only and self.groups, "has no effect without a curve (`delays_only`)"),
                (
                    "constants",
                    self.constants == "pair" and (self.fixed_ns or self.delays_from is not None),
                    "constants of pairs contain all delays, so none can be known; remove one of the two settings",
                ),
                (
                    "use",
                    self.use == "receptions" and beside != "use",
                    f"receptions cannot be fitted with `{beside}`",
                ),
                *(
                    (name, mode in ("shared", "tag") and beside, f"{mode} cannot be fitted with `{beside}`")
                    for name, mode in (("pattern", self.pattern), ("temperature", self.temperature))
                ),
            ]
        )
        seen: dict[int, str] = {}
        for name, tags in (self.groups or {}).items():
            listed = list(tags) if isinstance(tags, Iterable) and not isinstance(tags, str) else []
            if not listed or not all(map(is_tag, listed)):
                raise BadInputError(f"{name}: expected a list of tag ids, as in [1, 2]", parameter="groups")
            for tag in listed:
                if tag in seen:
                    raise BadInputError(f"tag {tag} is in {seen[tag]!r} and in {name!r}", parameter="groups")
                seen[tag] = name
        object.__setattr__(self, "groups", {name: tuple(map(int, tags)) for name, tags in (self.groups or {}).items()})

    @property
    def fitted_loss(self) -> str:
        """The loss that is fitted: without a curve errors depend on power, which the mixture would take for
        reflections."""
        return self.loss or ("cauchy" if self.sequential or self.delays_only else "mixture")

    @property
    def excludes_patterns(self) -> str:
        """The setting that excludes patterns over direction and slopes over temperature, "" if there is none."""
        if self.sequential:
            return "sequential"
        if self.constants == "pair":
            return "constants"
        return "use" if self.use == "receptions" else ""


def read_distances(texts: Iterable[str]) -> tuple[KnownDistance, ...]:
    """Return known distances from texts TAG-TAG=METRES[+-STD][@WHEN]; raises `BadInputError` for other texts."""
    from uwblink import KnownDistance

    number = r"\s*(\d+(?:\.\d*)?|\.\d+)\s*"
    form = re.compile(rf"\s*(\d+)\s*-\s*(\d+)\s*={number}(?:(?:\+-|±){number})?(?:@(.+))?$")
    found = []
    for text in texts:
        parts = form.match(text)
        if parts is None:
            raise BadInputError(
                f"found {text!r:.60}, expected TAG-TAG=METRES, as in 11-12=3.06, 11-12=3.06+-0.005 or 1-3=1.52@2..8",
                parameter="distances",
            )
        first, second, distance, sigma, when = parts.groups()
        # The default standard deviation is 1 cm, for a tape between antennas (a judgement).
        found.append(
            KnownDistance(int(first), int(second), float(distance), float(sigma or 0.01), (when or "").strip())
        )
    return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSettings(CheckedSettings):
    """Settings of `fit_from_ranges`, known facts about a flight without true distances; that function explains them.

    Raises `BadInputError` that names the setting.

    >>> import calib
    >>> flight = calib.FlightSettings(poses_until_s=3.0, heading_std_deg=1.0)
    >>> calib.fit_from_ranges(calib.sample_flight(450), flight).success
    True
    """

    poses_until_s: float | None = setting(
        None,
        "Seconds from the start during which the positions of the poses are used (by default all).",
        flag="--poses-until",
        metavar="SECONDS",
        rich_help_panel=FLIGHT_PANEL,
    )
    attitudes: str = setting(
        "poses",
        "Source of attitudes: the poses of the whole flight, the IMU, or none.",
        names=("poses", "imu", "none"),
        rich_help_panel=FLIGHT_PANEL,
    )
    heading_std_deg: float = setting(
        3.0,
        "Standard deviation of headings; 0: headings are exact.",
        flag="--heading-std",
        metavar="DEGREES",
        rich_help_panel=FLIGHT_PANEL,
    )
    anchors: str = setting(
        "given",
        "Positions of bodies that stand still. given: known from the poses; sought: estimated.",
        names=("given", "sought"),
        rich_help_panel=FLIGHT_PANEL,
    )
    distances: tuple[Any, ...] = setting(
        (),
        "Measured distance of two antennas, such as 11-12=3.06 (standard deviation 1 cm) or 3.06+-0.005. If the tags "
        "move, add when they stood still: 1-3=1.52@2..8 (seconds, or the name of an arrangement). May be repeated.",
        flag="--distance",
        kind=list[str] | None,
        parse=read_distances,
        metavar="TAG-TAG=METRES",
        rich_help_panel=FLIGHT_PANEL,
    )
    heights: str = setting(
        "used",
        "Readings of height sensors in the recording: used or ignored.",
        names=("used", "ignored"),
        rich_help_panel=FLIGHT_PANEL,
    )
    curve_from: Any = setting(  # a Calibration or its path
        None,
        "Calibration whose curve over power is used and not fitted (.json).",
        kind=Path | None,
        rich_help_panel=FLIGHT_PANEL,
    )
    minimum_norm: bool = setting(
        False,
        "If the ranges do not determine all delays, write the solution with the smallest delays.",
        rich_help_panel=FLIGHT_PANEL,
    )

    def __post_init__(self) -> None:
        """Check the settings."""
        CheckedSettings.__post_init__(self)
        object.__setattr__(self, "distances", tuple(self.distances))


@dataclass(frozen=True, slots=True, kw_only=True)
class SurveySettings(CheckedSettings):
    """Settings of `survey`, which also takes them as keyword arguments, with the known facts about the boards.

    `known` is "line" or "plane" for all arrangements, the path of a TOML file (`load_knowledge`), or a `Knowledge`:
    shapes, distances and positions, with their standard deviations. `fixed_ns` are known delays,
    `pair_error_m` is the constant error of a pair in an arrangement, estimated by default. `delays_only` fits no curve
    over power; `curve_from` is a calibration, or its path, whose curve is used and not fitted. `regardless` writes a
    calibration even if the ranges contradict the known facts. Raises `BadInputError` that names the setting.

    >>> import calib
    >>> string = calib.SurveySettings(known="line", pair_error_m=0.01)
    >>> sorted(calib.survey(calib.sample_arrangements(), string).calibration.delays_ns)
    [1, 2, 3, 4]
    """

    known: Any = setting(  # a word, a path or a Knowledge
        "",
        "Known geometry of the arrangements: all boards on a line or on a plane, or a file with known shapes, "
        "distances and positions (.toml).",
        kind=str,
        metavar="line|plane|FILE",
    )
    fixed_ns: Mapping[int, float] = setting({}, parse=read_fixed, **FIXED)
    pair_error_m: float | None = setting(
        None, "Constant error of a pair in an arrangement (m); by default estimated.", flag="--pair-error"
    )
    delays_only: bool = setting(False, "Fit no curve over power.")
    curve_from: Any = setting(  # a Calibration or its path
        None, "Calibration whose curve over power is used and not fitted (.json).", kind=Path | None
    )
    regardless: bool = setting(False, "Write a calibration even if the ranges contradict the known geometry.")

    def __post_init__(self) -> None:
        """Check the settings."""
        CheckedSettings.__post_init__(self)
        if self.curve_from is not None and self.delays_only:
            raise BadInputError("cannot be used with `delays_only`, which fits no curve", parameter="curve_from")
