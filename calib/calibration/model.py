"""The result of a fit: a frozen value, JSON both ways, and how to apply it."""

from __future__ import annotations

import json
import math
import os
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, Final, Literal, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from calib.calibration.display import as_html, as_text
from calib.calibration.error_model import ErrorModel, read_errors
from calib.calibration.json_format import Matrix, Reader
from calib.calibration.pair_offsets import PairOffset, offsets_from, offsets_m, table_of
from calib.calibration.power_curves import LIFTS, Curve, basis, ends, lift, lifted_power
from calib.calibration.runtime import CorrectedColumns, CorrectedRange, RangeCorrector
from calib.errors import BadInputError, UnanswerableError
from calib.ranges import HALVES, Ranges
from uwblink.arrays import Bools, Floats
from uwblink.display import as_text as table_text
from uwblink.display import excerpt
from uwblink.output import write_text
from uwblink.text_files import read_text

SCHEMA_VERSION: Final = 1
GROUPED_VERSION: Final = 2
"""A calibration with groups of tags says so by its version: whoever knows only one curve must not read it."""

RECEPTION_VERSION: Final = 3
"""And one whose curve is meant for each reception: whoever takes it at the mean power is wrong by up to a decimetre."""

PAIRS_VERSION: Final = 4
"""And one with constants of pairs."""

VERSIONS: Final = (SCHEMA_VERSION, GROUPED_VERSION, RECEPTION_VERSION, PAIRS_VERSION)
POWER_AT: Final = ("exchange", "reception")
OUTLIER: Final = 0.5
"""Probability above which a range of known error is marked as an outlier."""

SCALAR: Final = (float, int, np.generic)


@dataclass(frozen=True, slots=True, kw_only=True)
class CorrectedRanges:
    """Ranges in three stages, metres, and what is known of them, shape (n,).

    `sigma_m` is the noise of direct ranges. `sigma_total_m` is the standard deviation of all of them, reflected ones
    included, about a mean of `mean_error_m`; `tail_share` is how many such ranges of this pair at this power are
    reflected. `tail_probability` is the same after a look at the range itself, where its true distance is known, and
    `outlier` marks what is then neither noise nor a reflection; elsewhere it equals `tail_share`, and nothing is
    marked. `clamped` marks lifted powers at which the curves had no data and are held constant; `sigma_total_m` grows
    there by what they would go on by. All but `sigma_m` and `clamped` are NaN where a calibration does not say what
    errors are made of (`Calibration.errors`), and without a power.

    >>> import calib
    >>> flight = calib.load_ranges(calib.sample_flight())
    >>> corrected = calib.fit(flight).calibration.apply(flight)
    >>> corrected.corrected_m.shape
    (900,)
    """

    raw_m: Floats
    delay_corrected_m: Floats
    corrected_m: Floats
    sigma_m: Floats
    lifted: Floats
    clamped: Bools
    sigma_total_m: Floats
    mean_error_m: Floats
    tail_share: Floats
    tail_probability: Floats
    outlier: Bools

    def __repr__(self) -> str:
        """Return a headline and the first rows, in lines of 79 characters."""
        columns = {column.name: getattr(self, column.name) for column in fields(self)}
        return table_text(f"{len(self.raw_m)} corrected ranges", excerpt(columns))


@dataclass(frozen=True, slots=True)
class TagGroup:
    """Tags of one design, and their curves; a range between groups gets the mean of both groups' curves."""

    tags: tuple[int, ...]
    bias_curve: Curve
    sigma_curve: Curve


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """What is known of a fit's errors: covariance matrices as tuples of rows.

    `delays_ns2` (tags, tags) goes with `tags`; `bias_m2` and `sigma_m2` (m, m) go with the coefficients of the curves.
    """

    tags: tuple[int, ...]
    delays_ns2: Matrix
    bias_m2: Matrix
    sigma_m2: Matrix


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Calibration:
    """Antenna delays of tags, in nanoseconds, and the curves of bias and standard deviation.

    A standard error is infinite where the data did not determine the delay. `power_at` says where the bias curve is
    taken: "exchange", at the lifted power of an exchange as `lift` makes it of two; or "reception", at each of the two
    powers, half of either in a range, as curves are published that correct single stamps. With `groups`, each has its
    own curves, and the plain ones are the groups' average, for a look only. `errors` says what the errors of corrected
    ranges are made of, by pair and power; None where that is not known, as in older and in imported calibrations. With
    `pair_offsets`, by pair with the smaller id first, ranges of a pair read longer by its constant, beside what delays
    and curves say, and a pair that has none cannot be corrected.
    """

    delays_ns: dict[int, float]
    delays_std_ns: dict[int, float]
    loss: str
    scale_ns: float
    lift: str
    alpha_dbm: float
    speed_of_light: float
    bias_curve: Curve
    sigma_curve: Curve
    provenance: dict[str, Any] = field(default_factory=dict)
    uncertainty: Uncertainty | None = None
    groups: dict[str, TagGroup] = field(default_factory=dict)
    power_at: str = "exchange"
    errors: ErrorModel | None = None
    pair_offsets: dict[tuple[int, int], PairOffset] = field(default_factory=dict)
    _corrector: RangeCorrector | None = field(default=None, init=False, compare=False)

    def __repr__(self) -> str:
        """Return a table of delays, and of the curves at a few powers."""
        return as_text(self)

    def _repr_html_(self) -> str:
        """Return the same as HTML, for notebooks."""
        return as_html(self)

    def save(self, path: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the calibration as JSON, whole or not at all; replaces a file only with `force`."""
        write_text(Path(path), self.to_json(), force=force)

    @property
    def stopped(self) -> bool:
        """Whether the fit behind it stopped before it settled, so that delays and intervals are not final."""
        return self.provenance.get("converged") is False

    @property
    def needs_power(self) -> bool:
        """Whether ranges without any power cannot be corrected whole."""
        curves = [self.bias_curve, self.sigma_curve]
        curves += [curve for group in self.groups.values() for curve in (group.bias_curve, group.sigma_curve)]
        return not all(curve.flat for curve in curves)

    def lifted(self, ranges: Ranges) -> Floats:
        """Return the lifted power of each range, as this calibration defines it."""
        lifted = lifted_power(ranges.fpp1_dbm, ranges.fpp2_dbm, self.lift, self.alpha_dbm)
        # Where nothing depends on power, a range without any is as good as another.
        return lifted if self.needs_power else np.where(np.isfinite(lifted), lifted, self.bias_curve.range[0])

    def apply(self, ranges: Ranges) -> CorrectedRanges:
        """Correct ranges: c (w_i d_i + w_j d_j) for the delays (ICRA 2023, section III), then the curve.

        Raises `BadInputError` naming the tags that have no delay in this calibration, or the pair that has no constant.
        """
        missing = [t for t in ranges.tags() if t not in self.delays_ns]
        if missing:
            known = ", ".join(map(str, sorted(self.delays_ns)))
            raise BadInputError(
                f"{ranges.source}: no delay for tag {', '.join(map(str, missing))} in the calibration, "
                f"which knows {known}; fit one from a recording with all tags"
            )
        size = max(ranges.tags(), default=0) + 1
        delay_s = np.array([self.delays_ns.get(t, math.nan) for t in range(size)]) * 1e-9
        flight = ranges.weight_initiator * delay_s[ranges.initiator] + ranges.weight_target * delay_s[ranges.target]
        delays = ranges.raw_m + self.speed_of_light * flight - offsets_m(self.pair_offsets, ranges)
        lifted = self.lifted(ranges)
        corrected = delays - self._bias_of(ranges, lifted)
        return CorrectedRanges(
            raw_m=ranges.raw_m,
            delay_corrected_m=delays,
            corrected_m=corrected,
            sigma_m=self._curve_of(ranges, lifted, "sigma_curve"),
            lifted=lifted,
            clamped=~self.bias_curve.inside(lifted),
            **self._errors_of(ranges, lifted, corrected - ranges.truth_m),
        )

    def _errors_of(self, ranges: Ranges, lifted: Floats, error_m: Floats) -> dict[str, Any]:
        """Return what is known of the errors of ranges (n,), by the names of `CorrectedRanges`."""
        if self.errors is None:
            nothing = np.full(len(ranges), np.nan)
            names = ("sigma_total_m", "mean_error_m", "tail_share", "tail_probability")
            return dict.fromkeys(names, nothing) | {"outlier": np.zeros(len(ranges), dtype=bool)}
        shapes = self.errors.shapes(lifted, ranges.initiator, ranges.target)
        looked_at = np.isfinite(error_m)
        tail, outlier = self.errors.tail_given(np.where(looked_at, error_m, 0.0), shapes)
        return {
            "sigma_total_m": np.hypot(self.errors.total_m(shapes), self.bias_curve.beyond(lifted)),
            "mean_error_m": self.errors.mean_m(shapes),
            "tail_share": shapes.tail_share,
            "tail_probability": np.where(looked_at, tail, shapes.tail_share),
            "outlier": looked_at & (outlier > OUTLIER),
        }

    def quantiles(self, ranges: Ranges, shares: Sequence[float] = (0.025, 0.975)) -> Floats:
        """Return the errors (n, k), in metres, below which shares (k,) of the errors of such corrected ranges lie.

        By pair and power; the truth lies with 95 % between a corrected range less its 97.5 % and less its 2.5 %
        quantile. NaN without a power. Raises `UnanswerableError` for a calibration without `errors`, `BadInputError`
        for shares that are not between 0 and 1.

        >>> import calib
        >>> known = calib.fit(calib.sample_flight()).calibration
        >>> calib.load_ranges(calib.sample_flight(seed=2))[:2]
        <Ranges of memory: 2 of tags 1, 2, 3>
        >>> known.quantiles(calib.load_ranges(calib.sample_flight(seed=2))[:2], [0.5]).shape
        (2, 1)
        """
        if self.errors is None:
            raise UnanswerableError("the calibration does not say what errors are made of; fit anew from a recording")
        lifted = self.lifted(ranges)
        found = self.errors.quantiles(shares, lifted, ranges.initiator, ranges.target)
        total = self.errors.total_m(self.errors.shapes(lifted, ranges.initiator, ranges.target))
        return np.asarray(found * np.hypot(1, self.bias_curve.beyond(lifted) / total)[:, None])

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
    ) -> CorrectedRange: ...

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
    ) -> CorrectedColumns: ...

    def correct(
        self,
        range_m: Any,
        fpp1_dbm: Any,
        fpp2_dbm: Any,
        initiator: Any,
        target: Any,
        *,
        weights: tuple[Any, Any] = HALVES,
    ) -> CorrectedRange | CorrectedColumns:
        """Correct one range, or arrays of them (n,): the corrected range and its standard deviations, in metres.

        `range_m` is as the board gives it, powers are in dBm, NaN or 0 where a board has none. One range takes a few
        microseconds, for a robot's loop. `weights` are those of the two delays (`uwblink.twr.delay_weights`); halves
        take both clocks for equally fast (K = 1), wrong by a millionth of the delays, a hundredth of a millimetre at
        most. Equals `apply` otherwise, and raises what that raises.

        >>> import calib
        >>> known = calib.fit(calib.sample_flight()).calibration
        >>> corrected = known.correct(3.0, -85.0, -86.0, 1, 2)
        >>> f"{corrected.range_m:.2f} m, sigma {corrected.sigma_m:.2f} m"
        '2.94 m, sigma 0.03 m'
        """
        given = (range_m, fpp1_dbm, fpp2_dbm, initiator, target, *weights)
        if all([isinstance(value, SCALAR) for value in given]):  # noqa: C419 - a list takes half the time of a generator
            return self._one()(range_m, fpp1_dbm, fpp2_dbm, initiator, target, weights)
        ranges = Ranges.from_arrays(
            range_m, initiator=initiator, target=target, fpp1_dbm=fpp1_dbm, fpp2_dbm=fpp2_dbm, weights=weights
        )
        applied = self.apply(ranges)
        powered = np.isfinite(applied.lifted)
        corrected = np.where(powered, applied.corrected_m, applied.delay_corrected_m)
        return CorrectedColumns(
            corrected,
            np.where(powered, applied.sigma_m, np.nan),
            applied.clamped,
            applied.sigma_total_m,
            applied.tail_share,
        )

    def _one(self) -> RangeCorrector:
        """Return the corrector of single ranges, made when it is first asked for."""
        if self._corrector is not None:
            return self._corrector
        made = RangeCorrector(self)
        object.__setattr__(self, "_corrector", made)
        return made

    def _bias_of(self, ranges: Ranges, lifted: Floats) -> Floats:
        if self.power_at == "exchange":
            return self._curve_of(ranges, lifted, "bias_curve")
        powers = ends(ranges.fpp1_dbm, ranges.fpp2_dbm)
        first, second = (self._curve_of(ranges, lift(power, self.alpha_dbm), "bias_curve") for power in powers)
        return (first + second) / 2

    def _curve_of(self, ranges: Ranges, lifted: Floats, name: str) -> Floats:
        if not self.groups:
            return np.asarray(getattr(self, name)(lifted))
        member = {tag: group for group, known in self.groups.items() for tag in known.tags}
        lonely = [tag for tag in ranges.tags() if tag not in member]
        if lonely:
            raise BadInputError(f"{ranges.source}: tag {lonely[0]} is in none of the calibration's groups of tags")
        values = np.zeros(len(ranges))
        for known in self.groups.values():
            share = 0.5 * np.isin(ranges.initiator, known.tags) + 0.5 * np.isin(ranges.target, known.tags)
            rows = np.flatnonzero(share)
            values[rows] += share[rows] * getattr(known, name)(lifted[rows])
        return values

    def band(self, lifted: Floats, which: Literal["bias", "sigma"]) -> Floats | None:
        """Return the standard error of a curve at lifted powers (n,), in metres; None where it is not known."""
        if self.uncertainty is None:
            return None
        curve = self.bias_curve if which == "bias" else self.sigma_curve
        covariance = np.array(self.uncertainty.bias_m2 if which == "bias" else self.uncertainty.sigma_m2)
        splines = basis(np.clip(lifted, *curve.range), np.array(curve.knots))
        return np.asarray(np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", splines, covariance, splines), 0)))

    def to_json(self) -> str:
        """Return the calibration as JSON text."""
        document: dict[str, Any] = {
            "schema_version": self._version(),
            "delays_ns": {str(t): d for t, d in sorted(self.delays_ns.items())},
            "delays_std_ns": {str(t): d if math.isfinite(d) else None for t, d in sorted(self.delays_std_ns.items())},
            "loss": self.loss,
            "scale_ns": self.scale_ns,
            "lift": self.lift,
            "alpha_dbm": self.alpha_dbm,
            "speed_of_light": self.speed_of_light,
            "bias_curve": _curve_table(self.bias_curve),
            "sigma_curve": _curve_table(self.sigma_curve),
            "provenance": self.provenance,
        }
        if self.power_at != "exchange":
            document["power_at"] = self.power_at
        if self.groups:
            document["groups"] = {
                name: {
                    "tags": list(group.tags),
                    "bias_curve": _curve_table(group.bias_curve),
                    "sigma_curve": _curve_table(group.sigma_curve),
                }
                for name, group in self.groups.items()
            }
        if self.errors:
            document["errors"] = self.errors.to_dict()
        if self.pair_offsets:
            document["pair_offsets"] = table_of(self.pair_offsets)
        if self.uncertainty:
            document["uncertainty"] = asdict(self.uncertainty)
        return _rows_on_lines(json.dumps(document, indent=1, allow_nan=False)) + "\n"

    def _version(self) -> int:
        if self.pair_offsets:
            return PAIRS_VERSION
        if self.power_at != "exchange":
            return RECEPTION_VERSION
        return GROUPED_VERSION if self.groups else SCHEMA_VERSION

    @classmethod
    def from_json(cls, text: str, where: str = "calibration") -> Self:
        """Read a calibration; raises `BadInputError` that says `where`, and which key is wrong."""
        try:
            table = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise BadInputError(f"{where}: not JSON ({error})") from error
        if not isinstance(table, dict) or "schema_version" not in table:
            raise BadInputError(f"{where}: not a calibration (no schema_version)")
        if table["schema_version"] not in VERSIONS:
            raise BadInputError(
                f"{where}: schema version {table['schema_version']!r}, this uwbcal reads "
                f"{', '.join(map(str, VERSIONS[:-1]))} and {VERSIONS[-1]}"
            )
        read = Reader(table, where)
        how = read.word("lift")
        if how not in LIFTS:
            raise BadInputError(f"{where}: lift: found {how!r}, allowed: {', '.join(LIFTS)}")
        power_at = read.word("power_at") if read.has("power_at") else "exchange"
        if power_at not in POWER_AT:
            raise BadInputError(f"{where}: power_at: found {power_at!r}, allowed: {', '.join(POWER_AT)}")
        return cls(
            delays_ns=read.delays("delays_ns"),
            delays_std_ns=read.delays("delays_std_ns", missing=math.inf),
            loss=read.word("loss"),
            scale_ns=read.number("scale_ns"),
            lift=how,
            alpha_dbm=read.number("alpha_dbm"),
            speed_of_light=read.number("speed_of_light"),
            bias_curve=read.curve("bias_curve"),
            sigma_curve=read.curve("sigma_curve"),
            provenance=read.table("provenance"),
            uncertainty=_uncertainty(read),
            groups=_groups(read),
            power_at=power_at,
            errors=read_errors(read.inside("errors")) if read.has("errors") else None,
            pair_offsets=offsets_from(read) if read.has("pair_offsets") else {},
        )


def require_calibration(value: object, parameter: str = "calibration") -> None:
    """Raise `BadInputError` where an argument is no `Calibration`."""
    if not isinstance(value, Calibration):
        raise BadInputError(
            f"found {value!r:.60}, expected a Calibration; `load_calibration` reads one from a file",
            parameter=parameter,
        )


def load_calibration(path: str | os.PathLike[str]) -> Calibration:
    """Return the calibration in a JSON file; raises `BadInputError` that names the file, and the key that is wrong.

    >>> import calib
    >>> calib.load_calibration("nowhere.json")
    Traceback (most recent call last):
    ...
    calib.errors.BadInputError: nowhere.json: no such calibration file (.json)
    """
    return Calibration.from_json(read_text(path, BadInputError, "calibration file (.json)"), str(path))


def _rows_on_lines(text: str) -> str:
    """Put lists of numbers on one line each: a matrix reads as rows."""
    return re.sub(
        r"\[[-+.e\d,\s]+\]", lambda found: " ".join(found[0].split()).replace("[ ", "[").replace(" ]", "]"), text
    )


def _curve_table(curve: Curve) -> dict[str, Any]:
    return {
        "knots": list(curve.knots),
        "coefficients": list(curve.coefficients),
        "degree": curve.degree,
        "range": list(curve.range),
    }


def _uncertainty(read: Reader) -> Uncertainty | None:
    if not read.has("uncertainty"):
        return None
    inner = read.inside("uncertainty")
    tags = tuple(int(tag) for tag in inner.numbers("tags", least=0))
    bias, sigma = (len(read.curve(name).coefficients) for name in ("bias_curve", "sigma_curve"))
    return Uncertainty(
        tags,
        inner.matrix("delays_ns2", len(tags)),
        inner.matrix("bias_m2", bias),
        inner.matrix("sigma_m2", sigma),
    )


def _groups(read: Reader) -> dict[str, TagGroup]:
    if not read.has("groups"):
        return {}
    every, found = read.inside("groups"), {}
    for name in read.table("groups"):
        inner = every.inside(name)
        tags = tuple(int(tag) for tag in inner.numbers("tags"))
        found[name] = TagGroup(tags, inner.curve("bias_curve"), inner.curve("sigma_curve"))
    return found
