"""The calibration: antenna delays, curves and error model, the correction of ranges, and tables."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Annotated, Any, Final, Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, PlainSerializer, TypeAdapter

from calib.calibration.applying import (
    CorrectedArrivals,
    CorrectedRange,
    CorrectedRanges,
    columns_of,
    corrected_arrivals,
    corrected_ranges,
)
from calib.calibration.document import (
    IN_ORDER,
    DelayNs,
    FreeStdNs,
    Light,
    Matrix,
    Metres,
    PairKey,
    PowerDbm,
    Split,
    StdM,
    StdNs,
    TagKey,
    Tags,
    expect,
    one_of,
    pair_name,
    read,
    reading_provenance,
    with_current_keys,
    write,
)
from calib.calibration.error_model import CheckedErrors
from calib.calibration.patterns import CheckedPattern, CheckedSlope, dependences_m
from calib.calibration.power_curves import LIFTS, BiasCurve, SigmaCurve, lifted_power
from calib.data.ranges import Ranges
from calib.errors import BadInputError, UnanswerableError
from calib.findings import Finding
from calib.spread import TWO_SIDED_95
from uwblink.arrays import Floats
from uwblink.display import as_html, as_text, first_few
from uwblink.errors import raising
from uwblink.output import write_text
from uwblink.recording.antenna_delays import REGISTER_MAX, AntennaDelay
from uwblink.text_files import read_text


def matrix_of(values: Floats) -> Matrix:
    """Return an array (n, k) as a tuple of rows."""
    return tuple(map(tuple, values.tolist()))


@dataclass(frozen=True, slots=True)
class TagGroup:
    """Tags of one design, and their curves; a range between two groups uses the mean of both groups' curves."""

    tags: Tags
    bias_curve: BiasCurve
    sigma_curve: SigmaCurve


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Covariance matrices of a fit.

    `delays_ns2` (tags, tags) is that of the delays of `tags`; `bias_m2` and `sigma_m2` (m, m) are those of the
    coefficients of the two curves.
    """

    tags: Tags
    delays_ns2: Matrix
    bias_m2: Matrix
    sigma_m2: Matrix


@dataclass(frozen=True, slots=True)
class PairOffset:
    """Constant error of the ranges of a pair (positive: too long), and its standard error, in metres."""

    offset_m: Metres
    std_m: StdM


def _are_registers(table: Any) -> bool:
    fields = isinstance(table, dict) and set(table) == set(AntennaDelay._fields)
    return fields and all(type(value) is int and 0 <= value <= REGISTER_MAX for value in table.values())


Registers = Annotated[
    AntennaDelay,
    expect(
        f"tx, rx and reply in ticks of a register of 16 bits, 0 to {REGISTER_MAX}",
        _are_registers,
        lambda table: AntennaDelay(**table),
    ),
    PlainSerializer(AntennaDelay._asdict),
]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Calibration:
    """Antenna delays of tags, in nanoseconds, and the curves of bias and standard deviation.

    A standard error is infinite if the data do not determine the delay. `power_at` is the argument of the bias curve:
    "exchange", the lifted power of the exchange, which `lift` computes from both powers; or "reception", each of the
    two powers, with half of each bias in a range, as in published curves that correct single stamps. If there are
    `groups`, each has its own curves, and `bias_curve` and `sigma_curve` are their averages, for display only. `errors`
    is the error model of corrected ranges, by pair and power; None if unknown, as in older and in imported
    calibrations. `pair_offsets`, by pair with the smaller id first, are constant errors in addition to delays and
    curves; if there are any, pairs without one cannot be corrected. `antenna_delays` were programmed into the tags
    during the recording, and the delays are relative to them; empty if unknown.

    `undetermined_splits` are pairs of sides, such as anchors and robots, whose tags ranged only with the other side:
    all delays of one side can increase and those of the other decrease by the same amount. Of their ranges, only those
    between the two sides can be corrected. If one side is empty, all delays of the other can be shifted together: they
    are stated relative to their mean, and correct only differences of arrival without stamps. `patterns` describe the
    dependence of ranges on the directions between the antennas, and `temperatures` that on the temperatures of both
    ends; if directions or temperatures are unknown, ranges are corrected without them, and `sigma_total_m` includes
    the missing effect.
    """

    delays_ns: Annotated[dict[TagKey, DelayNs], IN_ORDER]
    delays_std_ns: Annotated[dict[TagKey, FreeStdNs], IN_ORDER]
    loss: str
    scale_ns: StdNs
    lift: Annotated[str, one_of(LIFTS)]
    alpha_dbm: PowerDbm
    speed_of_light: Light
    bias_curve: BiasCurve
    sigma_curve: SigmaCurve
    provenance: Annotated[dict[str, Any], AfterValidator(with_current_keys)] = field(default_factory=dict)
    power_at: Annotated[str, one_of(("exchange", "reception"))] = "exchange"
    groups: dict[str, TagGroup] = field(default_factory=dict)
    errors: CheckedErrors | None = None
    pair_offsets: Annotated[dict[PairKey, PairOffset], IN_ORDER] = field(default_factory=dict)
    antenna_delays: Annotated[Mapping[TagKey | None, Registers], IN_ORDER] = field(default_factory=dict)
    uncertainty: Uncertainty | None = None
    undetermined_splits: tuple[Split, ...] = ()
    patterns: tuple[CheckedPattern, ...] = ()
    temperatures: tuple[CheckedSlope, ...] = ()

    @property
    def sides(self) -> dict[int, int]:
        """The side of each tag in a split: the number of the split, from 1, with the sign + or - for its two sides."""
        return {
            tag: sign * number
            for number, sides in enumerate(self.undetermined_splits, 1)
            for sign, tags in zip((1, -1), sides, strict=True)
            for tag in tags
        }

    def interval_std_ns(self) -> dict[int, float]:
        """Return the standard errors of the delays, except those known only through constants of pairs.

        If only differences of delays are known, they are the standard errors of the delays minus their mean.
        """
        relative = {tag for sides in self.undetermined_splits if not all(sides) for tags in sides for tag in tags}
        return {
            tag: self.std_of_sum_ns([tag]) if tag in relative else self.delays_std_ns.get(tag, math.nan)
            for tag in sorted(self.delays_ns)
            if tag in relative or tag not in self.sides
        }

    @property
    def pair_constants(self) -> dict[tuple[int, int], PairOffset]:
        """The constant errors of pairs whose delays are not known separately.

        These are `pair_offsets`, and those of pairs between the sides of `undetermined_splits`.
        """
        found, half_m = dict(self.pair_offsets), 0.5e-9 * self.speed_of_light
        for one, other in self.undetermined_splits:
            for pair in sorted((min(a, b), max(a, b)) for a in one for b in other):
                delay_ns = sum(self.delays_ns[tag] for tag in pair)
                found[pair] = PairOffset(-half_m * delay_ns, half_m * self.std_of_sum_ns(pair))
        return found

    def std_of_sum_ns(self, tags: Collection[int]) -> float:
        """Return the standard error of the sum of some tags' delays in ns, NaN if the covariance is not known."""
        if self.uncertainty is None:
            return math.nan
        own = np.isin(self.uncertainty.tags, list(tags))
        return math.sqrt(max(float(own @ np.array(self.uncertainty.delays_ns2) @ own), 0.0))

    def covariance_ns2(self, tags: Sequence[int]) -> Floats:
        """Return the covariance of some delays (tags, tags) in ns², 0 for those without a finite standard error.

        It is that of the fit if known; otherwise it is diagonal, with the squares of the standard errors. Raises
        `BadInputError` for tags without a delay.
        """
        if missing := [str(tag) for tag in tags if tag not in self.delays_ns]:
            raise BadInputError(f"no delay of tag {', '.join(missing)} in the calibration")
        std_ns = np.array([self.delays_std_ns.get(tag, math.nan) for tag in tags])
        found = np.diag(np.where(np.isfinite(std_ns), std_ns, 0.0) ** 2)
        if self.uncertainty is not None:
            rows = np.flatnonzero(np.isin(tags, self.uncertainty.tags))
            own = [self.uncertainty.tags.index(tag) for tag in tags if tag in self.uncertainty.tags]
            stated = np.reshape(self.uncertainty.delays_ns2, (len(self.uncertainty.tags),) * 2)
            found[np.ix_(rows, rows)] = stated[np.ix_(own, own)]
        return found

    @property
    def stopped(self) -> bool:
        """Whether the fit stopped before it converged, so that delays and intervals are not final."""
        return self.provenance.get("converged") is False

    @property
    def needs_power(self) -> bool:
        """Whether the full correction of a range needs its power."""
        curves: tuple[Calibration | TagGroup, ...] = (self, *self.groups.values())
        return not all(one.bias_curve.flat and one.sigma_curve.flat for one in curves)

    def lifted(self, ranges: Ranges) -> Floats:
        """Return the lifted power of each range, as this calibration defines it."""
        lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, self.lift, self.alpha_dbm)
        # If all curves are flat, ranges without power get any lifted power, and so the full correction.
        return lifted if self.needs_power else np.where(np.isfinite(lifted), lifted, self.bias_curve.range[0])

    def __repr__(self) -> str:
        """Return tables of delays, constants, dependences, and of the curves at a few powers."""
        return "\n".join([_headline(self), *(as_text(title, rows) for title, rows in _tables(self).items())])

    def _repr_html_(self) -> str:
        """Return the same as HTML, for notebooks."""
        tables = [as_html(title, rows) for title, rows in _tables(self).items()]
        return f"<p>{escape(_headline(self))}</p>{''.join(tables)}"

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the calibration as JSON.

        The file appears when it is complete; an existing file is replaced only with `force`. Raises the errors of
        `uwblink.output.write_text`.
        """
        write_text(Path(path), self.to_json(), force=force)

    def apply(self, ranges: Ranges) -> CorrectedRanges:
        """Correct ranges: add c (w_i d_i + w_j d_j) for the delays (ICRA 2023, section III), subtract constants of
        pairs, the bias curve, and the effects of direction and temperature.

        Raises `BadInputError` that names tags without a delay in this calibration, a pair without a constant, or pairs
        that the calibration cannot correct because of an undetermined split.
        """
        return corrected_ranges(self, ranges)

    def correct_arrivals(self, ranges: Ranges) -> CorrectedArrivals:
        """Correct differences of arrival at listeners: for the target's delay, the bias of each reception, and the
        range.

        The result has a row for each of the ranges' `arrivals`. For initiator i, target j and listener k, with bias b
        and noise e of the receptions of poll (1) and response (2) and the antenna delay D_j, the measured difference is
        d_jk - d_ik - c D_j + b1_j + b2_k - b1_k plus noise (`calib.data.arrivals`). The corrected range is used in
        place of the distance d_ij, so the noise is (e1_j - e2_i)/2 + e2_k - e1_k. Its variance is sigma_ij^2 +
        2 sigma_jk^2 + 2 sigma_ik^2, with the curve at the powers of exchange, response and poll, because a reception
        has twice the variance of a range. If the clock rates are compared by a third message, one factor is above 2 and
        the other below (`applying.reception_gains`). The listener's delay cancels. Raises `BadInputError` without
        differences of arrival, if a delay is unknown or known only in a sum with others, and if there are patterns.

        >>> import calib
        >>> ranges = calib.load_ranges(calib.sample_flight())
        >>> calib.fit(ranges).calibration.correct_arrivals(ranges)
        Traceback (most recent call last):
        ...
        calib.errors.BadInputError: memory: no differences of arrival, because no tag overheard these ranges
        """
        return corrected_arrivals(self, ranges)

    def quantiles(self, ranges: Ranges, shares: Sequence[float] = (0.025, 0.975)) -> Floats:
        """Return the quantiles (n, k) of the errors of corrected ranges, in metres, for shares (k,).

        They depend on pair, power and features; without a power they are NaN. With 95 % probability the true distance
        lies between the corrected range minus its 97.5 % quantile and the corrected range minus its 2.5 % quantile.
        Raises `UnanswerableError` for a calibration without `errors`, and `BadInputError` for shares that are not
        between 0 and 1.

        >>> import calib
        >>> known = calib.fit(calib.sample_flight()).calibration
        >>> calib.load_ranges(calib.sample_flight(seed=2))[:2]
        <Ranges of memory: 2 of tags 1, 2, 3>
        >>> known.quantiles(calib.load_ranges(calib.sample_flight(seed=2))[:2], [0.5]).shape
        (2, 1)
        """
        if self.errors is None:
            raise UnanswerableError("the calibration has no error model; fit it again from a recording")
        lifted = self.lifted(ranges)
        where = (lifted, ranges.initiator, ranges.target, self.errors.log_odds_of(ranges.features))
        found = self.errors.quantiles(shares, *where)
        total = self.errors.total_m(self.errors.shapes(*where))
        more = np.hypot(self.bias_curve.beyond(lifted), dependences_m(self, ranges)[1])
        return np.asarray(found * np.hypot(1, more / total)[:, None])

    @overload
    def correct(
        self,
        range_m: float,
        fpp1_dbm: float,
        fpp2_dbm: float,
        initiator: int,
        target: int,
        *,
        weights: tuple[float, float] = ...,
        azimuth_deg: tuple[float, float] = ...,
        elevation_deg: tuple[float, float] = ...,
        temperature_c: tuple[float, float] = ...,
    ) -> CorrectedRange[float]: ...

    @overload
    def correct(
        self,
        range_m: Floats,
        fpp1_dbm: ArrayLike,
        fpp2_dbm: ArrayLike,
        initiator: ArrayLike,
        target: ArrayLike,
        *,
        weights: tuple[ArrayLike, ArrayLike] = ...,
        azimuth_deg: tuple[ArrayLike, ArrayLike] = ...,
        elevation_deg: tuple[ArrayLike, ArrayLike] = ...,
        temperature_c: tuple[ArrayLike, ArrayLike] = ...,
    ) -> CorrectedRange[Floats]: ...

    def correct(  # noqa: PLR0913 - columns by name
        self,
        range_m: Any,
        fpp1_dbm: Any,
        fpp2_dbm: Any,
        initiator: Any,
        target: Any,
        *,
        weights: tuple[Any, Any] = (0.5, 0.5),
        azimuth_deg: tuple[Any, Any] = (math.nan, math.nan),
        elevation_deg: tuple[Any, Any] = (0.0, 0.0),
        temperature_c: tuple[Any, Any] = (math.nan, math.nan),
    ) -> CorrectedRange[Any]:
        """Correct one range, or arrays of them (n,); return the corrected range and its standard deviations, in
        metres.

        `range_m` is the range that the board reports; powers are in dBm, NaN or 0 if the board has none. A call takes
        less than a millisecond, for one range or for hundreds. `weights` are those of the two delays
        (`uwblink.twr.delay_weights`); the default, one half each, assumes equal clock rates. Rates differ by at most
        40 ppm (IEEE 802.15.4, 15.4.9), which changes a range by less than 0.01 mm per ns of delay. `azimuth_deg` and
        `elevation_deg` are the directions from the antennas of initiator and target to each other, in the frames of
        their bodies, NaN if unknown; only a calibration with `patterns` uses them. `temperature_c` are the temperatures
        of initiator and target; only a calibration with `temperatures` uses them. Results and errors are those of
        `apply`, but a range without power is corrected for delays only.

        >>> import calib
        >>> known = calib.fit(calib.sample_flight()).calibration
        >>> corrected = known.correct(3.0, -85.0, -86.0, 1, 2)
        >>> f"{corrected.range_m:.2f} m, sigma {corrected.sigma_m:.2f} m"
        '2.94 m, sigma 0.03 m'
        """
        ranges = Ranges.from_arrays(
            range_m,
            initiator=initiator,
            target=target,
            fpp1_dbm=fpp1_dbm,
            fpp2_dbm=fpp2_dbm,
            weights=weights,
            azimuth_deg=azimuth_deg,
            elevation_deg=elevation_deg,
            temperature_c=temperature_c,
        )
        found = columns_of(self.apply(ranges))
        ends = (*weights, *azimuth_deg, *elevation_deg, *temperature_c)
        columns = (range_m, fpp1_dbm, fpp2_dbm, initiator, target, *ends)
        if any(map(np.ndim, columns)):
            return found
        return CorrectedRange(*(column.item() for column in found))

    @property
    def curve_covariance_m2(self) -> Floats:
        """The covariance (m, m) of the coefficients of the bias curve, zero if it is not stated."""
        size = len(self.bias_curve.coefficients)
        return np.zeros((size, size)) if self.uncertainty is None else np.array(self.uncertainty.bias_m2)

    def band(self, lifted: Floats, which: Literal["bias", "sigma"]) -> Floats | None:
        """Return the standard error of a curve at lifted powers (n,), in metres; None if it is not known."""
        if self.uncertainty is None:
            return None
        curve = self.bias_curve if which == "bias" else self.sigma_curve
        covariance = self.curve_covariance_m2 if which == "bias" else np.array(self.uncertainty.sigma_m2)
        splines = curve.splines(lifted)
        return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", splines, covariance, splines), 0)))

    def to_json(self) -> str:
        """Return the calibration as JSON text."""
        return write(self, _ADAPTER)

    @staticmethod
    def from_json(text: str, where: str = "calibration") -> Calibration:
        """Read a calibration; raises `BadInputError` that names `where` and the key."""
        return read(_ADAPTER, text, where)


def _checked(calibration: Calibration) -> Calibration:
    """Return a calibration; raises `ValueError` if splits, dependences or sizes of covariances do not agree."""
    parts = {
        "undetermined_splits": [tags for sides in calibration.undetermined_splits for tags in sides],
        "patterns": [one.tags for one in calibration.patterns],
        "temperatures": [one.tags for one in calibration.temperatures],
    }
    for key, some in parts.items():
        named = [tag for tags in some for tag in tags]
        if len(set(named)) < len(named) or not calibration.delays_ns.keys() >= set(named):
            raise ValueError(f"{key}: expected calibrated tags, each one once")
    age_line(calibration)
    known = calibration.uncertainty
    if known is None:
        return calibration
    sizes = {
        "delays_ns2": len(known.tags),
        "bias_m2": len(calibration.bias_curve.coefficients),
        "sigma_m2": len(calibration.sigma_curve.coefficients),
    }
    for name, size in sizes.items():
        rows = getattr(known, name)
        # Rounding errors may make a variance of 0 slightly negative.
        if len(rows) != size or any(len(row) != size or row[k] < -1e-9 for k, row in enumerate(rows)):
            raise ValueError(
                f"uncertainty: {name}: expected {size} rows of {size} numbers, with variances of 0 or more"
            )
    return calibration


_ADAPTER: Final[TypeAdapter[Calibration]] = TypeAdapter(Annotated[Calibration, AfterValidator(_checked)])


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Return the calibration in a JSON file; raises `BadInputError` that names the file and the wrong key.

    >>> import calib
    >>> calib.load_calibration("nowhere.json")
    Traceback (most recent call last):
    ...
    calib.errors.BadInputError: nowhere.json: no such calibration file (.json)
    """
    return Calibration.from_json(read_text(path, BadInputError, "calibration file (.json)"), str(path))


class CalibrationResult:
    """Base of the results of a fit and of a survey: a calibration, a headline on its data, and findings."""

    __slots__ = ()
    calibration: Calibration
    findings: Sequence[Finding]

    @property
    def warnings(self) -> list[str]:
        """The findings as sentences."""
        return [str(one) for one in self.findings]

    def headline(self) -> str:
        """Return one line about the data of the calibration."""
        raise NotImplementedError

    def __repr__(self) -> str:
        """Return the headline, the calibration as a table, and the warnings."""
        return "\n".join([self.headline(), repr(self.calibration), *(f"warning: {text}" for text in self.warnings)])

    def _repr_html_(self) -> str:
        """Return the same as HTML, for notebooks."""
        warned = "".join(f"<p><b>Warning:</b> {escape(text)}</p>" for text in self.warnings)
        return f"<p>{escape(self.headline())}</p>{self.calibration._repr_html_()}{warned}"

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the calibration as JSON (`Calibration.save`)."""
        self.calibration.save(path, force=force)


CalibrationSource = Calibration | CalibrationResult | str | os.PathLike[str]
"""A calibration, the result of a fit or a survey, or the path of a calibration file."""


def given_calibration(source: CalibrationSource, parameter: str = "calibration") -> Calibration:
    """Return the calibration that an argument contains or names.

    Raises `BadInputError` that names `parameter` for objects of other types, and the errors of `load_calibration`.
    """
    known = load_calibration(source) if isinstance(source, str | os.PathLike) else source
    known = getattr(known, "calibration", known)
    if not isinstance(known, Calibration):
        seen = f"found {type(source).__name__}"
        raise BadInputError(f"{seen}, expected a Calibration, the result of a fit, or a path", parameter=parameter)
    return known


def given_curve(source: CalibrationSource | None) -> Calibration | None:
    """Return the calibration whose curve the argument `curve_from` asks to use, None without one.

    Raises `BadInputError` where it has no single curve of all exchanges, and the errors of `given_calibration`.
    """
    known = None if source is None else given_calibration(source, "curve_from")
    if known is not None and (known.groups or known.power_at != "exchange"):
        what = "curves of groups of tags" if known.groups else "a curve of each reception"
        raise BadInputError(f"has {what}, expected one curve of all exchanges", parameter="curve_from")
    return known


def _tables(calibration: Calibration) -> dict[str, list[tuple[str, ...]]]:
    """Return the tables of a calibration by title; those without rows are left out."""
    bodies = {
        "Antenna delays": [("tag", "delay (ns)", "interval"), *delay_rows(calibration)],
        "Constants": [("pair", "constant (cm)", "interval"), *pair_rows(calibration)],
        "Patterns over direction": [("tags", "rms (cm)", "most"), *pattern_rows(calibration)],
        "Slopes over temperature": [("tags", "slope", "interval"), *temperature_rows(calibration)],
        "Odds of a reflection": [("feature", "factor per unit", "between"), *feature_rows(calibration)],
    }
    most = 40  # tags or pairs that are printed, about a screen
    tables: dict[str, list[tuple[str, ...]]] = {
        title: [*rows[: most + 1], *[("...", "", f"{len(rows) - 1 - most} more")] * (len(rows) > most + 1)]
        for title, rows in bodies.items()
        if len(rows) > 1
    }
    return tables | {"Curves": curve_rows(calibration)}


def interval(std: float, digits: int = 4) -> str:
    """Return the text of the 95 % interval of a value with this standard error."""
    words = {0.0: "pinned", math.inf: "undetermined"}
    known = f"± {TWO_SIDED_95 * std:.{digits}f} (95 %)" if math.isfinite(std) else "standard error not stated"
    return words.get(std, known)


def pair_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Return each pair, the constant of its ranges in cm, and its interval in words."""
    offsets = sorted(calibration.pair_constants.items())
    return [(pair_name(pair), f"{100 * one.offset_m:+.2f}", interval(100 * one.std_m, 2)) for pair, one in offsets]


def delay_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Return tag, delay in ns, and the text of its interval, except for tags known only through constants of pairs.

    If only differences of delays are known, the delays are relative to their mean.
    """
    if calibration.pair_offsets and not any(calibration.delays_ns.values()):
        return []
    return [
        (
            str(tag),
            f"{calibration.delays_ns[tag]:+.4f}",
            interval(std) + ", less the mean of all" * (tag in calibration.sides),
        )
        for tag, std in calibration.interval_std_ns().items()
    ]


def pattern_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Return the tags of each pattern over direction, its root mean square in cm, and its largest value at elevation 0,
    with the azimuth.
    """
    around = np.radians(np.arange(360))
    level = np.column_stack([np.cos(around), np.sin(around), np.zeros(360)])
    rows = []
    for pattern in calibration.patterns:
        values = pattern.values(level)
        longer, std = values @ np.array(pattern.coefficients_m), pattern.std_m(values)
        top = int(np.argmax(longer))
        most = f"{100 * longer[top]:+.1f} cm at azimuth {top}°, {interval(100 * float(std[top]), 1)}"
        rows.append((first_few(map(str, pattern.tags)), f"{100 * pattern.rms_m:.1f}", most))
    return rows


def temperature_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Return the tags of each slope over temperature, the slope, and the text of its interval and reference
    temperature.
    """
    why = _sentence(calibration, "temperature", lambda entry: str(entry.get("why") or ""), BadInputError)
    rows = [
        (
            first_few(map(str, one.tags)),
            f"{1e3 * one.m_per_k:+.2f} mm/K",
            f"{interval(1e3 * one.std_m_per_k, 2)}, from {one.reference_c:.1f} °C",
        )
        for one in calibration.temperatures
    ]
    return rows + [("all", "none", why)] * bool(why)


def feature_rows(calibration: Calibration) -> list[tuple[str, str, str]]:
    """Return each feature that indicates reflections, the factor on their odds per unit, and its bounds."""
    rows = []
    for name, one in (calibration.errors.features if calibration.errors else {}).items():
        low, high = one.bounds
        unit = "taps" if name == "rise_taps" else "dB"
        rows.append((name, f"{math.exp(one.log_odds):.2f}", f"{low:.1f} and {high:.1f} {unit}"))
    return rows


def curve_rows(calibration: Calibration) -> list[tuple[str, ...]]:
    """Return a row of lifted powers, and rows of the values of the curves there, for each group of tags."""
    low, high = calibration.bias_curve.range
    # A fit at one power, or without powers, has a range without extent.
    shown = np.linspace(low, high, 6 if high > 1.01 * low else 1)
    named: dict[str, Calibration | TagGroup] = dict(calibration.groups) or {"": calibration}
    rows = [("lifted power", *(f"{power:.3g}" for power in shown))]
    for name, curves in named.items():
        of = f" {name}" if name else ""
        rows.append((f"bias (cm){of}", *(f"{100 * value:+.1f}" for value in curves.bias_curve(shown))))
        rows.append((f"sigma (cm){of}", *(f"{100 * value:.1f}" for value in curves.sigma_curve(shown))))
    return rows


def _headline(calibration: Calibration) -> str:
    fitted = calibration.provenance.get("exchanges")
    of = f" from {fitted} ranges" if fitted else ""
    return (
        f"Calibration of {len(calibration.delays_ns)} tags{of}: {calibration.loss} loss, scale "
        f"{calibration.scale_ns:.3g} ns, {calibration.lift} power above {calibration.alpha_dbm:g} dBm"
        f"{'; NOT CONVERGED, its fit stopped' if calibration.stopped else ''}"
    )


def known_facts(provenance: Mapping[str, Any]) -> str:
    """Return a text on the facts that a fit used instead of known distances; "" if distances were known."""
    known = provenance.get("geometry")
    if provenance.get("truth") != "ranges" or not isinstance(known, Mapping):
        return ""
    off, seconds = provenance.get("distance_std_m"), known.get("known_s")
    anchors = {"given": known.get("anchors_given"), "found": known.get("anchors_sought")}
    parts = [
        f"ranges only, of {_listed(known.get('moving'), 'moving body', 'moving bodies')}",
        f"positions known for {seconds:.1f} s" if isinstance(seconds, int | float) and seconds > 0 else "",
        *(f"{_listed(one, 'anchor', 'anchors')} at positions that were {how}" for how, one in anchors.items() if one),
        f"attitudes from {known.get('attitudes', 'nowhere')}",
        f"standard error of the distances: {100 * off:.1f} cm" if isinstance(off, int | float) else "",
    ]
    return ", ".join(filter(None, parts))


@reading_provenance()
def warnings_of(calibration: Calibration) -> list[str]:
    """Return the warnings of the fit, as sentences."""
    return list(map(str, calibration.provenance.get("warnings", [])))


def held_out_line(calibration: Calibration) -> str:
    """Return one line on the errors of held-out ranges with a fit to the others; "" if none were held out."""
    return _sentence(calibration, "held_out", _held_out, BadInputError)


def _sentence(
    calibration: Calibration, key: str, sentence: Callable[[Mapping[str, Any]], str], error: type[Exception]
) -> str:
    """Return the text of an entry of the provenance by the function `sentence`; "" without an entry.

    Raises `error` if the entry has not the form that a fit writes.
    """
    entry = calibration.provenance.get(key)
    if not isinstance(entry, Mapping):
        return ""
    with raising(error, f"provenance: {key}: not as `calib fit` writes it", KeyError, TypeError, ValueError):
        return sentence(entry)


def _held_out(entry: Mapping[str, Any]) -> str:
    inside = "" if entry["inside_95"] is None else f", {100 * entry['inside_95']:.0f} % within their 95 % intervals"
    return (
        f"evaluated on {entry['ranges']} ranges held out by {entry['fold']}: median "
        f"{100 * entry['raw_median_m']:+.1f} to {100 * entry['median_m']:+.1f} cm, robust deviation "
        f"{100 * entry['raw_robust_std_m']:.1f} to {100 * entry['robust_std_m']:.1f} cm{inside}"
    )


def age_line(calibration: Calibration) -> str:
    """Return one line: the number of days during which 95 % of delays change ranges by less than 2 cm.

    It is "" if the fit did not have several sessions with dates.
    """
    return _sentence(calibration, "drift", _age, ValueError)


def _age(entry: Mapping[str, Any]) -> str:
    # Delays are random walks, with a variance of ranges of `m2_per_day` (lower bound, estimate, upper bound).
    least, likeliest, most = ((0.02 / TWO_SIDED_95) ** 2 / max(rate, 1e-12) for rate in entry["m2_per_day"][::-1])
    within = "95 % of delays change ranges by less than 2 cm for"
    days = f"{within} {likeliest:.0f} days ({least:.0f} to {most:.0f}, 95 %)"
    over = f"{entry['sessions']} sessions over {entry['days']:.0f} days"
    if not entry["told"]:
        return f"{over} show no drift: {within} {least:.0f} days or more"
    why = "delays drift" if entry["by_age"] else "delays differ, but not significantly by age; if it is a drift"
    return f"{over}: {why}, {days}"


def _listed(names: object, one: str, many: str) -> str:
    count = len(names) if isinstance(names, list) else 0
    return f"{count} {one if count == 1 else many}"
