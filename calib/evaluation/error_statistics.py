"""What range errors come to: of a pair, or of all."""

from __future__ import annotations

from dataclasses import dataclass


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

    `rejected` is the share of fully corrected errors whose square exceeds the 95 % quantile of
    chi-square times sigma squared, `accepted` the statistics of the others. `rejected_raw` is the same share of raw
    errors with the variance that all of them have, which is what there is without a calibration. `coverage` maps a
    nominal share of a normal distribution to the share of corrected errors within its bounds.

    With all that errors are made of: `total_mean` and `total_std` are mean and standard deviation of errors, less the
    mean that is expected of them, over `sigma_total_m` (0 and 1 if right); `inside_95` is the share between the 2.5 and
    97.5 % quantiles by pair and power, `tail_share` how many of the ranges should be reflected. NaN where the
    calibration does not say.
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
