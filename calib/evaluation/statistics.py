"""Errors of a calibration on ranges with known truth: by stage of correction, for all ranges and by pair."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from scipy.interpolate import BSpline

import calib
from calib.calibration.applying import CorrectedRanges, keep_determined
from calib.calibration.comparison import loose_shifts
from calib.calibration.document import for_json, pair_name
from calib.calibration.model import Calibration, CalibrationSource, given_calibration
from calib.calibration.patterns import lack_direction, warn_of_directions
from calib.data.ranges import Ranges
from calib.data.sources import Data, load_ranges
from calib.spread import TWO_SIDED_95, medians, robust_spread, spreads
from uwblink.arrays import Bools, Floats, data_frame
from uwblink.display import as_html
from uwblink.ticks import SPEED_OF_LIGHT

CORRECTION_STAGES: Final = {"raw": "raw_m", "delays": "delay_corrected_m", "full": "corrected_m"}
"""Names of the stages of correction in `CorrectedRanges`."""

NOMINAL: Final = {"50": 0.6744897501960817, "68": 1.0, "90": 1.6448536269514722, "95": TWO_SIDED_95,
                  "99": 2.5758293035489004}  # fmt: skip
"""Two-sided bounds of a standard normal distribution, by per cent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Stats:
    """Statistics of range errors in metres; `robust_std_m` is 1.4826 median absolute deviations.

    95 % of the errors lie between `low_m` and `high_m`, with as many below as above; 95 % are smaller than `abs95_m`.
    """

    n: int
    mean_m: float
    median_m: float
    std_m: float
    robust_std_m: float
    low_m: float
    high_m: float
    abs95_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorStatistics:
    """A pair, or all pairs: statistics in the three stages, and the chi-square test.

    `rejected` is the share of fully corrected errors whose square exceeds the 95 % quantile of chi-square times sigma
    squared, `accepted` the statistics of the others. `rejected_raw` is the same share of raw errors with their common
    variance, as without a calibration. `coverage` maps a nominal share of a normal distribution to the share of
    corrected errors within its bounds.

    With reflections: `total_mean` and `total_std` are mean and standard deviation of errors minus their expected mean,
    divided by `sigma_total_m` (0 and 1 if right); `inside_95` is the share between the 2.5 and 97.5 % quantiles by pair
    and power, `tail_share` the expected share of reflected ranges. NaN if the calibration does not state them.
    """

    raw: Stats
    delays: Stats
    full: Stats
    rejected_raw: float
    rejected: float
    accepted: Stats
    coverage: dict[str, float]
    clamped: float
    total_mean: float
    total_std: float
    inside_95: float
    tail_share: float


@dataclass(frozen=True, slots=True)
class PlantedComparison:
    """The difference between a calibration and the planted values of a simulation, without the common constant.

    Shifts along undetermined splits of the calibration are removed from the delays as well.

    `delay_error_ns` maps tags to fitted minus planted delays, `curve_rms_m` is the rms of the bias curves' difference
    over the ranges inside the fitted power, `correction_rms_m` the rms difference of the whole correction of each
    range; NaN if no curve was planted.
    """

    shift_ns: float
    delay_error_ns: dict[int, float]
    curve_rms_m: float
    correction_rms_m: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorSplit:
    """Standard deviations of corrected errors in metres: within a pair and session, and of the constants of these.

    `between_pairs_m` is the deviation between pairs, `between_sessions_m` of a pair between sessions (NaN with one
    session or one pair).
    """

    within_m: float
    between_pairs_m: float
    between_sessions_m: float
    sessions: int


@dataclass(frozen=True, slots=True, repr=False)
class Evaluation:
    """Errors of all ranges and of each pair, named "smaller-larger".

    `seen` names the recordings that the calibration was fitted to: their errors are too small.
    """

    overall: ErrorStatistics
    pairs: dict[str, ErrorStatistics]
    split: ErrorSplit
    planted: PlantedComparison | None
    seen: tuple[str, ...] = ()

    def __repr__(self) -> str:
        """Return a table of errors in cm, a row a pair."""
        rows = self._rows()
        widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
        lines = [" ".join(f"{cell:>{width}}" for cell, width in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([TITLE, *lines])

    def _repr_html_(self) -> str:
        """Return the same as HTML, and a figure of the errors by pair, for notebooks."""
        from uwblink.pages.figures import notebook_image

        draw = partial(calib.figures.errors_by_pair, found=self)
        return as_html(TITLE, self._rows()) + notebook_image(draw, "errors by pair, raw and corrected")

    def _rows(self) -> list[list[str]]:
        above = ["", "", "raw", "", "", "delay", "", "", "full", "", "", *(column[0] for column in ERROR_COLUMNS)]
        head = ["pair", "n", *3 * ["mean", "med.", "rob."], *(column[1] for column in ERROR_COLUMNS)]
        return [
            above,
            head,
            *([name, *_cells(group)] for name, group in self.pairs.items()),
            ["all", *_cells(self.overall)],
        ]

    def to_pandas(self) -> Any:
        """Return a row a pair, and one of all, as a `pandas.DataFrame`; raises `ArgumentError` without pandas."""
        return data_frame(
            [{"pair": name} | asdict(group) for name, group in (self.pairs | {"all": self.overall}).items()]
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the output of `calib evaluate --json`; `planted` only if a simulation planted values."""
        document: dict[str, Any] = {
            "seen_by_fit": list(self.seen),
            "overall": for_json(asdict(self.overall)),
            "pairs": {name: for_json(asdict(group)) for name, group in self.pairs.items()},
            "split": for_json(asdict(self.split)),
        }
        return document | ({"planted": for_json(asdict(self.planted))} if self.planted else {})


def stage_cells(group: ErrorStatistics) -> list[str]:
    """Return the number of ranges, and in cm the mean, median and robust standard deviation of errors by stage."""
    stages = (group.raw, group.delays, group.full)
    errors_m = [error for stats in stages for error in (stats.mean_m, stats.median_m, stats.robust_std_m)]
    return [str(group.raw.n), *(f"{100 * error:.1f}" for error in errors_m)]


ERROR_COLUMNS: Final[tuple[tuple[str, str, str, Callable[[ErrorStatistics], str]], ...]] = (
    ("chi2", "out%", "per cent that chi-square rejects at 95 %", lambda group: f"{100 * group.rejected:.1f}"),
    ("total", "z std", "standard deviation over the total sigma", lambda group: f"{group.total_std:.2f}"),
    ("in", "95%", "per cent within their 95 % interval", lambda group: f"{100 * group.inside_95:.1f}"),
)
"""The columns of the table after those of the stages: two lines of its header, words for its title, and the cell of a
group. A new statistic is a field of `ErrorStatistics`, its value in `_group`, and a row here."""

TITLE: Final = "; ".join(
    [
        "Range errors in cm: mean, median and robust standard deviation, raw, with delays and fully corrected",
        *(column[2] for column in ERROR_COLUMNS),
    ]
)


def _cells(group: ErrorStatistics) -> list[str]:
    cells = [*stage_cells(group), *(column[3](group) for column in ERROR_COLUMNS)]
    return ["-" if "nan" in cell else cell for cell in cells]


def evaluate(data: Data | Iterable[Data], calibration: CalibrationSource) -> Evaluation:
    """Compare raw, delay-corrected and fully corrected ranges with the truth, for all ranges and for each pair of tags.

    `data` is what `load_ranges` takes: paths of recordings, simulations in memory, `Ranges`, one or several. Errors are
    in metres. Ranges of pairs that the calibration does not determine are left out, with a `LeftOutWarning`; a
    `DirectionWarning` states the share of ranges whose directions are needed but unknown. Raises what `load_ranges` and
    `Calibration.apply` raise.

    >>> import calib
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> found = calib.evaluate(calib.sample_flight(seed=2), known).overall
    >>> f"{100 * found.raw.std_m:.1f} cm raw, {100 * found.full.std_m:.1f} cm corrected"
    '4.0 cm raw, 3.0 cm corrected'
    """
    calibration = given_calibration(calibration)
    ranges = keep_determined(calibration, load_ranges(data, need_power=calibration.needs_power))
    warn_of_directions(int(np.count_nonzero(lack_direction(calibration, ranges))), len(ranges), ranges.source)
    applied = calibration.apply(ranges)
    everything = np.ones(len(ranges), dtype=bool)
    inside = _between_quantiles(ranges, applied, calibration)
    # Older calibrations do not state their fitted recordings.
    known = calibration.provenance.get("recording_ids")
    return Evaluation(
        _group(ranges, applied, everything, inside),
        {name: _group(ranges, applied, rows, inside) for name, rows in pair_rows(ranges).items()},
        split_error(ranges, applied.corrected_m - ranges.truth_m),
        compare_with_planted(ranges, applied, calibration),
        tuple(name for name, found in ranges.recordings if isinstance(known, list) and found in known),
    )


def compare_with_planted(
    ranges: Ranges, applied: CorrectedRanges, calibration: Calibration
) -> PlantedComparison | None:
    """Compare a calibration with the planted values of a simulation, if the ranges contain these."""
    planted = {int(tag): float(delay) for tag, delay in (ranges.planted or {}).get("delays_ns", {}).items()}
    difference = {tag: calibration.delays_ns[tag] - d for tag, d in planted.items() if tag in calibration.delays_ns}
    if not difference:
        return None
    loose, apart = loose_shifts([calibration], list(difference)), np.array(list(difference.values()))
    taken = np.linalg.lstsq(loose, apart)[0]
    shift, delays = float(taken[0]), dict(zip(difference, (apart - loose @ taken).tolist(), strict=True))
    inside = ~applied.clamped
    truth = planted_curve(ranges, "bias_curve", applied.lifted[inside])
    curve_rms = correction_rms = float("nan")
    if truth is not None and inside.any():
        fitted = (applied.delay_corrected_m - applied.corrected_m)[inside]
        curve = fitted - truth - shift * 1e-9 * SPEED_OF_LIGHT
        wrong = np.zeros(max(*ranges.tags(), *delays) + 1)
        wrong[list(delays)] = list(delays.values())
        ends = ranges.weight_initiator * wrong[ranges.initiator] + ranges.weight_target * wrong[ranges.target]
        curve_rms = float(np.sqrt(np.mean(curve**2)))
        correction_rms = float(np.sqrt(np.mean((ends[inside] * 1e-9 * SPEED_OF_LIGHT - curve) ** 2)))
    return PlantedComparison(shift, delays, curve_rms, correction_rms)


def planted_curve(ranges: Ranges, which: str, lifted: Floats) -> Floats | None:
    """Return a curve that the simulation planted, at lifted powers (n,), or None."""
    curve: dict[str, Any] | None = (ranges.planted or {}).get(which)
    if not curve:
        return None
    knots, degree = np.array(curve["knots"], dtype=float), int(curve["degree"])
    inside = np.clip(lifted, knots[degree], knots[-1 - degree])
    return BSpline(knots, np.array(curve["coefficients"], dtype=float), degree)(inside)


def pair_rows(ranges: Ranges) -> dict[str, Bools]:
    """Return which ranges belong to each pair of tags, whoever initiated."""
    pairs = ranges.pairs
    return {pair_name(ends): pairs.number == k for k, ends in enumerate(pairs.ends.tolist())}


def split_error(ranges: Ranges, error_m: Floats) -> ErrorSplit:
    """Split errors (n,) into variation within a pair and session, and between pairs and sessions.

    Groups are described by median and robust spread, so that reflections have little weight. The variance between
    groups is the variance of their medians minus the part that chance explains (1.57 s²/n for n errors of spread s;
    DerSimonian and Laird 1986). Errors that last for seconds are treated as independent, so short sessions seem to
    differ. Groups of fewer than 5 ranges are left out.
    """
    pair, count = ranges.pairs.number, int(ranges.session.max(initial=0)) + 1
    codes, group, counts = np.unique(pair * count + ranges.session, return_inverse=True, return_counts=True)
    large = counts >= 5
    if not large.any():
        return ErrorSplit(within_m=np.nan, between_pairs_m=np.nan, between_sessions_m=np.nan, sessions=0)
    centre, squares = medians(error_m, group)[large], spreads(error_m, group)[large] ** 2
    chance, (pairs, sessions) = 1.57 * squares / counts[large], np.divmod(codes[large], count)
    _, number, members = np.unique(pairs, return_inverse=True, return_counts=True)
    centres = np.bincount(number, centre) / members
    freedom = len(pairs) - len(centres)
    apart = float(np.sum((centre - centres[number]) ** 2))
    between_sessions = max(apart / freedom - float(chance.mean()), 0.0) if freedom else np.nan
    of_centres = (np.nan_to_num(between_sessions) + np.bincount(number, chance) / members) / members
    between_pairs = float(np.var(centres, ddof=1) - np.mean(of_centres)) if len(centres) > 1 else np.nan
    return ErrorSplit(
        within_m=float(np.sqrt(np.average(squares, weights=counts[large]))),
        between_pairs_m=float(np.sqrt(np.maximum(between_pairs, 0.0))),
        between_sessions_m=float(np.sqrt(between_sessions)),
        sessions=len(np.unique(sessions)),
    )


def statistics(error_m: Floats) -> Stats:
    """Return the statistics of range errors (n,); NaN where there are none."""
    some = error_m if len(error_m) else np.full(1, np.nan)
    low, high = np.quantile(some, (0.025, 0.975))
    return Stats(
        n=len(error_m),
        mean_m=float(np.mean(some)),
        median_m=float(np.median(some)),
        std_m=float(np.std(some)),
        robust_std_m=robust_spread(some),
        low_m=float(low),
        high_m=float(high),
        abs95_m=float(np.quantile(np.abs(some), 0.95)),
    )


def _between_quantiles(ranges: Ranges, applied: CorrectedRanges, calibration: Calibration) -> Floats:
    """Return 1 where an error (n,) lies between the quantiles that hold 95 %, else 0; NaN if they are unknown."""
    if calibration.errors is None:
        return np.full(len(ranges), np.nan)
    low, high = calibration.quantiles(ranges, (0.025, 0.975)).T
    error = applied.corrected_m - ranges.truth_m
    return np.asarray((error > low) & (error < high), dtype=np.float64)


def _group(ranges: Ranges, applied: CorrectedRanges, rows: Bools, inside: Floats) -> ErrorStatistics:
    truth = ranges.truth_m[rows]
    errors = {name: getattr(applied, field)[rows] - truth for name, field in CORRECTION_STAGES.items()}
    z = np.abs(errors["full"]) / applied.sigma_m[rows]
    outside = z > TWO_SIDED_95
    variance = float(np.var(applied.raw_m - ranges.truth_m))
    total = (errors["full"] - applied.mean_error_m[rows]) / applied.sigma_total_m[rows]
    return ErrorStatistics(
        **{name: statistics(error) for name, error in errors.items()},
        rejected_raw=float(np.mean(errors["raw"] ** 2 > TWO_SIDED_95**2 * variance)),
        rejected=float(np.mean(outside)),
        accepted=statistics(errors["full"][~outside]),
        coverage={name: float(np.mean(z <= bound)) for name, bound in NOMINAL.items()},
        clamped=float(np.mean(applied.clamped[rows])),
        total_mean=float(np.mean(total)),
        total_std=float(np.std(total)),
        inside_95=float(np.mean(inside[rows])),
        tail_share=float(np.mean(applied.tail_share[rows])),
    )
