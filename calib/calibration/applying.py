"""Correct ranges by a calibration: delays, curve, expected errors."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Generic, Literal, NamedTuple

import numpy as np

from calib.calibration.document import Value, pair_name, split_text
from calib.calibration.patterns import dependences_m, warn_of_temperatures
from calib.calibration.power_curves import ends, lift
from calib.data.arrivals import Arrivals
from calib.data.ranges import Ranges
from calib.errors import BadInputError, LeftOutWarning
from uwblink.arrays import Bools, ColumnTable, Floats
from uwblink.display import as_text, excerpt, first_few
from uwblink.errors import warn

if TYPE_CHECKING:
    from calib.calibration.model import Calibration


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CorrectedRanges(ColumnTable):
    """Raw, delay-corrected and fully corrected ranges in metres, with their expected errors, shape (n,).

    `sigma_m` is the noise of direct ranges. `sigma_total_m` is the standard deviation of all errors, reflections
    included, about their mean `mean_error_m`; `tail_share` is the probability of a reflection by pair, power and
    features. If the true distance of a range is known, `tail_probability` is the probability of a reflection given the
    error, and `outlier` marks errors that are neither noise nor a reflection; otherwise `tail_probability` equals
    `tail_share`, and `outlier` is False. `clamped` marks lifted powers outside the fitted ones, where the curves are
    held constant; there `sigma_total_m` includes the slope of the curve at its end. It also includes the effect of
    unknown directions and temperatures. These expected errors (`sigma_total_m` to `tail_probability`) are NaN if the
    calibration has no error model (`Calibration.errors`). If a range has no power and the calibration needs it, all but
    `raw_m`, `delay_corrected_m` and the flags are NaN.

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

    def _title(self) -> str:
        return f"{len(self)} corrected ranges"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CorrectedArrivals(ColumnTable):
    """Differences of arrival in metres, shape (n,): a listener's distance to the target minus that to the initiator.

    `sigma_m` is the noise without reflections. The covariance of two differences of one exchange is the square of
    `shared_m`. Differences are not correlated with the range of their exchange, nor with other exchanges. `late_share`
    is the probability that a reflection of the response makes the difference longer, `early_share` that a reflection of
    the poll makes it shorter; NaN if the calibration has no error model.
    """

    raw_m: Floats
    corrected_m: Floats
    sigma_m: Floats
    shared_m: Floats
    late_share: Floats
    early_share: Floats

    def _title(self) -> str:
        return f"{len(self)} corrected differences of arrival"


class CorrectedRange(NamedTuple, Generic[Value]):
    """A corrected range and its standard deviation, metres; `clamped` if its power is outside the fitted powers.

    `sigma_m` is the noise of a direct range; `sigma_total_m` includes reflections, whose probability at this pair and
    power is `tail_share`; the latter two are NaN without an error model. If neither end has a power, the range is
    corrected for delays only, and its standard deviations are NaN. Each is a number, or an array (n,).
    """

    range_m: Value
    sigma_m: Value
    clamped: Any
    sigma_total_m: Value
    tail_share: Value

    def __repr__(self) -> str:
        """Return a headline and the first rows, in lines of 79 characters."""
        columns = {name: np.atleast_1d(values) for name, values in self._asdict().items()}
        return as_text(f"{len(columns['range_m'])} corrected ranges", excerpt(columns))


def corrected_ranges(calibration: Calibration, ranges: Ranges) -> CorrectedRanges:
    """Correct ranges; `Calibration.apply` calls this function and describes result and errors."""
    delays = _without_delays(calibration, ranges)
    lifted = calibration.lifted(ranges)
    longer, unknown = dependences_m(calibration, ranges)
    warn_of_temperatures(calibration, ranges)
    corrected = delays - _bias(calibration, ranges, lifted) - longer
    return CorrectedRanges(
        raw_m=ranges.raw_m,
        delay_corrected_m=delays,
        corrected_m=corrected,
        sigma_m=noise_m(calibration, ranges),
        lifted=lifted,
        clamped=np.isfinite(lifted) & ~calibration.bias_curve.inside(lifted),
        **_errors(calibration, ranges, lifted, corrected - ranges.truth_m, unknown),
    )


def corrected_arrivals(calibration: Calibration, ranges: Ranges) -> CorrectedArrivals:
    """Correct differences of arrival; `Calibration.correct_arrivals` calls this function and describes result and
    errors.
    """
    heard, receptions = arrivals_in(ranges), heard_receptions(ranges)
    exchange = replace(ranges, arrivals=None)[heard.exchange]
    summed = sorted(
        set(exchange.tags()) & {*calibration.sides, *(t for pair in calibration.pair_offsets for t in pair)}
    )
    if summed:
        raise BadInputError(
            f"{ranges.source}: the calibration has only sums of the delays of tags {first_few(map(str, summed))}, "
            f"and differences of arrival need the delay of each tag; fit them with `use` receptions"
        )
    if calibration.patterns:
        raise BadInputError(
            f"{ranges.source}: the calibration has patterns over direction, which cannot correct overheard frames; "
            f"fit one with `pattern` none"
        )
    applied = corrected_ranges(calibration, exchange)
    delay_ns = np.array([calibration.delays_ns[tag] for tag in exchange.target.tolist()])
    late_m = 1e-9 * calibration.speed_of_light * delay_ns - reception_bias_m(calibration, receptions)
    # A range contains half of the target's delay, a difference of arrival the whole delay: hence the factor of 2.
    of_target = replace(exchange, temperature_c=np.where([False, True], exchange.temperature_c, np.float32(np.nan)))
    late_m -= 2 * dependences_m(calibration, of_target)[0]
    sigma, model = np.column_stack([noise_m(calibration, one) for one in receptions[:2]]), calibration.errors
    late_share, early_share = np.full((2, len(heard)), np.nan)
    if model is not None:
        shapes = (model.shapes(calibration.lifted(one), one.initiator, one.target) for one in receptions[:2])
        late_share, early_share = (one.tail_share for one in shapes)
    return CorrectedArrivals(
        raw_m=heard.raw_m,
        corrected_m=heard.raw_m + late_m - (applied.corrected_m - exchange.raw_m),
        sigma_m=np.sqrt(applied.sigma_m**2 + np.sum(reception_gains(heard) * sigma**2, axis=1)),
        shared_m=applied.sigma_m,
        late_share=late_share,
        early_share=early_share,
    )


def arrivals_in(ranges: Ranges) -> Arrivals:
    """Return the differences of arrival of ranges; raises `BadInputError` if there are none."""
    if ranges.arrivals is None:
        raise BadInputError(f"{ranges.source}: no differences of arrival, because no tag overheard these ranges")
    return ranges.arrivals


def heard_receptions(ranges: Ranges) -> tuple[Ranges, Ranges, Ranges]:
    """Return the receptions that differences of arrival (n,) contain, as ranges with the power of the reception.

    They are the response at the listener, the poll at the listener, and the poll at the target.
    """
    heard = arrivals_in(ranges)
    initiator, target, listener = ranges.initiator[heard.exchange], ranges.target[heard.exchange], heard.listener
    at_target_dbm = ends(ranges.fpp1_dbm, ranges.fpp2_dbm)[0][heard.exchange]
    response, poll, at_target = (
        Ranges.from_arrays(np.zeros(len(heard)), initiator=sender, target=receiver, fpp1_dbm=power_dbm)
        for sender, receiver, power_dbm in (
            (target, listener, heard.response_dbm),
            (initiator, listener, heard.poll_dbm),
            (initiator, target, at_target_dbm),
        )
    )
    return response, poll, at_target


def reception_bias_m(calibration: Calibration, receptions: tuple[Ranges, Ranges, Ranges]) -> Floats:
    """Return the bias (n,) of differences of arrival, in metres, from the three receptions of `heard_receptions`."""
    response, poll, at_target = (_bias(calibration, one, calibration.lifted(one)) for one in receptions)
    return response - poll + at_target


def reception_gains(heard: Arrivals) -> Floats:
    """Return the factors (n, 2) of the variance of a range in the variance of a difference: of response and of poll.

    A range is the mean of two receptions, so a reception has twice the variance of a range. If the clock rates are
    compared over an interval that starts with one of the receptions, its error has the weight 1 + s, and the error of
    the reception at the end of the interval the weight s (`Arrivals.stretch`). The same holds for the range, which then
    has (1 + (1 + s)^2 + s^2)/4 of the variance of a reception.
    """
    twice = (1 + heard.stretch) ** 2 + heard.stretch**2
    gains = 4 / (1 + twice)[:, None] * np.column_stack([twice, np.ones_like(twice)])
    return np.where(heard.stretch[:, None] < 0, gains[:, ::-1], gains)


def noise_m(calibration: Calibration, ranges: Ranges) -> Floats:
    """Return the standard deviation of direct ranges (n,) in metres, NaN if a power is needed and missing."""
    return _curve(calibration, ranges, calibration.lifted(ranges), "sigma_curve")


def _without_delays(calibration: Calibration, ranges: Ranges) -> Floats:
    """Return ranges (n,) corrected for the delays of both tags and for constants of pairs, in metres."""
    missing = [t for t in ranges.tags() if t not in calibration.delays_ns]
    if missing:
        known = ", ".join(map(str, sorted(calibration.delays_ns)))
        raise BadInputError(
            f"{ranges.source}: no delay of tag {', '.join(map(str, missing))} in the calibration, which has those of "
            f"{known}; fit one from a recording with all tags"
        )
    if not (good := determined(calibration, ranges)).all():
        raise BadInputError(undetermined_text(calibration, ranges, good))
    size = max(ranges.tags(), default=0) + 1
    delay_s = np.array([calibration.delays_ns.get(t, math.nan) for t in range(size)]) * 1e-9
    flight = ranges.weight_initiator * delay_s[ranges.initiator] + ranges.weight_target * delay_s[ranges.target]
    return ranges.raw_m + calibration.speed_of_light * flight - _offsets_m(calibration, ranges)


def determined(calibration: Calibration, ranges: Ranges) -> Bools:
    """Return a mask (n,) of the ranges that a calibration can correct.

    The sum of both delays must be determined; for differences of arrival without stamps, their difference.
    """
    sides, pairs = calibration.sides, ranges.pairs
    first, second = (
        np.array([[sides.get(tag, 0) for tag in pair] for pair in pairs.ends.tolist()], int).reshape(-1, 2).T
    )
    return np.asarray(np.where(ranges.differences, (first == second)[pairs.number], (first == -second)[pairs.number]))


def keep_determined(calibration: Calibration, ranges: Ranges) -> Ranges:
    """Return the ranges that a calibration can correct, or all if it can correct none; a `LeftOutWarning` names the
    others.
    """
    good = determined(calibration, ranges)
    if good.all() or not good.any():
        return ranges
    left_out = f"{np.count_nonzero(~good)} of {len(good)} ranges are left out"
    warn(f"{undetermined_text(calibration, ranges, good)}; {left_out}", LeftOutWarning)
    return ranges[good]


def undetermined_text(calibration: Calibration, ranges: Ranges, good: Bools) -> str:
    """Return a sentence that names the pairs of the ranges that are not in the mask `good` (n,), with the reason."""
    names = first_few(ranges[~good].pairs.names)
    why = split_text(calibration.undetermined_splits)
    return f"{ranges.source}: the calibration cannot correct the ranges of {names}: {why}"


def _offsets_m(calibration: Calibration, ranges: Ranges) -> Floats:
    """Return the constant error of each range's pair (n,), zeros if the calibration has delays of tags instead."""
    offsets = calibration.pair_offsets
    if not offsets:
        return np.zeros(len(ranges))
    pairs = ranges.pairs
    ends = list(map(tuple, pairs.ends.tolist()))
    missing = [pair_name(pair) for pair in ends if pair not in offsets]
    if missing:
        known = first_few(map(pair_name, sorted(offsets)))
        raise BadInputError(f"no constant of pair {missing[0]} in the calibration, which has those of {known}")
    return np.array([offsets[pair].offset_m for pair in ends])[pairs.number]


def _errors(
    calibration: Calibration, ranges: Ranges, lifted: Floats, error_m: Floats, unknown_m: Floats
) -> dict[str, Any]:
    """Return the expected errors of ranges (n,), by the names of fields of `CorrectedRanges`.

    `error_m` (n,) are the errors, NaN if unknown; `unknown_m` (n,) is the standard deviation by unknown directions and
    temperatures.
    """
    model = calibration.errors
    if model is None:
        nothing = np.full(len(ranges), np.nan)
        names = ("sigma_total_m", "mean_error_m", "tail_share", "tail_probability")
        return dict.fromkeys(names, nothing) | {"outlier": np.zeros(len(ranges), dtype=bool)}
    shapes = model.shapes(lifted, ranges.initiator, ranges.target, model.log_odds_of(ranges.features))
    known = np.isfinite(error_m)
    tail, outlier = shapes.tail_share, known
    if known.any():
        tail, outlier_probability = model.tail_given(np.where(known, error_m, 0.0), shapes)
        outlier = known & (outlier_probability > 0.5)
    return {
        "sigma_total_m": np.hypot(np.hypot(model.total_m(shapes), calibration.bias_curve.beyond(lifted)), unknown_m),
        "mean_error_m": model.mean_m(shapes),
        "tail_share": shapes.tail_share,
        "tail_probability": np.where(known, tail, shapes.tail_share),
        "outlier": outlier,
    }


def _bias(calibration: Calibration, ranges: Ranges, lifted: Floats) -> Floats:
    """Return the bias of ranges (n,) in metres: the curve at the power of the exchange, or the mean over receptions."""
    if calibration.power_at == "exchange":
        return _curve(calibration, ranges, lifted, "bias_curve")
    first, second = (
        _curve(calibration, ranges, lift(power, calibration.alpha_dbm), "bias_curve")
        for power in ends(ranges.fpp1_dbm, ranges.fpp2_dbm)
    )
    return (first + second) / 2


def _curve(
    calibration: Calibration, ranges: Ranges, lifted: Floats, name: Literal["bias_curve", "sigma_curve"]
) -> Floats:
    """Return a curve at lifted powers (n,), in metres; with groups, the mean of the curves of both tags' groups."""
    if not calibration.groups:
        return np.asarray(getattr(calibration, name)(lifted))
    member = {tag for group in calibration.groups.values() for tag in group.tags}
    without = [tag for tag in ranges.tags() if tag not in member]
    if without:
        raise BadInputError(f"{ranges.source}: tag {without[0]} is in none of the calibration's groups of tags")
    values = np.zeros(len(ranges))
    for group in calibration.groups.values():
        share = 0.5 * np.isin(ranges.initiator, group.tags) + 0.5 * np.isin(ranges.target, group.tags)
        rows = np.flatnonzero(share)
        values[rows] += share[rows] * getattr(group, name)(lifted[rows])
    return values


def columns_of(applied: CorrectedRanges) -> CorrectedRange[Floats]:
    """Return corrected ranges as `Calibration.correct` does: ranges without power are corrected for delays only."""
    powered = np.isfinite(applied.lifted)
    return CorrectedRange(
        np.where(powered, applied.corrected_m, applied.delay_corrected_m),
        np.where(powered, applied.sigma_m, np.nan),
        applied.clamped,
        applied.sigma_total_m,
        applied.tail_share,
    )
