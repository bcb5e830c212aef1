"""Comparison of two calibrations: a chi-square test of the differences of their delays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np
from scipy.special import chdtrc

from calib.calibration.document import for_json
from calib.calibration.model import Calibration, CalibrationSource, given_calibration, interval
from calib.calibration.patterns import HARMONICS
from calib.errors import UnanswerableError
from uwblink.arrays import Floats
from uwblink.display import first_few
from uwblink.ticks import SPEED_OF_LIGHT


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class CalibrationComparison:
    """Differences of two calibrations, second minus first.

    A common shift of all delays has the same effect as a constant of the curve, so it is removed from the delays, and
    the sum of both effects is `offset_m`: the additional correction of every range by the second calibration, at equal
    power. Shifts along `undetermined_splits` are removed as well. If both have slopes over temperature or patterns over
    direction, delays are compared at the reference temperature and in the average direction of the first.
    `curve_rms_m` is the standard deviation of the difference of both bias curves. `pattern_rms_m` is the root mean
    square of the difference of the patterns over all directions, and `pattern_probability` the probability of a larger
    one by chance; both are NaN without patterns. `std_ns` is NaN for tags without a standard error in one of the
    calibrations, such as published ones. `chi_square` has `degrees` of freedom; without any, `chi_square` and
    `probability` are NaN. `only_first` and `only_second` are tags that were not compared.
    """

    difference_ns: dict[int, float]
    std_ns: dict[int, float]
    offset_m: float
    curve_rms_m: float
    chi_square: float
    degrees: int
    probability: float
    pattern_rms_m: float
    pattern_probability: float
    only_first: tuple[int, ...]
    only_second: tuple[int, ...]

    @property
    def same(self) -> bool:
        """Whether differences as large as these occur by chance in more than 5 % of cases; False if not tested."""
        return self.probability >= 0.05

    @property
    def verdict(self) -> str:
        """Return "same", "different", or "unknown" if no differences could be tested."""
        return "unknown" if np.isnan(self.probability) else "same" if self.same else "different"

    def __repr__(self) -> str:
        """Return the table."""
        return self.table()

    def table(self, first: str = "the first", second: str = "the second") -> str:
        """Return a line per tag in ns, the common offset in cm, and the verdict; `first` and `second` are names."""
        lines = [
            f"  tag {tag:3d}  {difference:+.4f} ns  {interval(self.std_ns[tag])}"
            for tag, difference in self.difference_ns.items()
        ]
        shapes = (
            f"offset of all ranges {100 * self.offset_m:+.1f} cm, "
            f"shape of the bias curves {100 * self.curve_rms_m:.1f} cm rms"
        )
        patterns = (
            f"patterns over direction {100 * self.pattern_rms_m:.1f} cm rms apart, probability "
            f"{self.pattern_probability:.3f}"
        )
        sides = (first, self.only_first), (second, self.only_second)
        only = [f"only in {name}: tags {', '.join(map(str, tags))}" for name, tags in sides if tags]
        verdict = (
            "not tested: too few tags have a standard error in both calibrations"
            if self.verdict == "unknown"
            else f"the delays are {'the same' if self.same else 'different'}: chi-square {self.chi_square:.1f} with "
            f"{self.degrees} degrees of freedom, probability {self.probability:.3f}"
        )
        return "\n".join([*lines, shapes, *([] if np.isnan(self.pattern_rms_m) else [patterns]), *only, verdict])

    def to_dict(self) -> dict[str, Any]:
        """Return what `calib compare --json` prints."""
        table: dict[str, Any] = for_json(asdict(self) | {"verdict": self.verdict})
        return table


def compare(first: CalibrationSource, second: CalibrationSource) -> CalibrationComparison:
    """Test whether the delays of two calibrations differ by more than their standard errors explain, by chi-square.

    Differences in ns are second minus first, without the common shift of all delays and shifts along undetermined
    splits. Raises `UnanswerableError` if fewer than two tags have a determined delay in both, if one of them has
    constants of pairs, and if a tag has a pattern over direction or a slope over temperature in only one of them.

    >>> import calib
    >>> first, second = (calib.fit(calib.sample_flight(seed=seed)).calibration for seed in (1, 2))
    >>> calib.compare(first, second).same
    True
    """
    first, second = both = given_calibration(first, "first"), given_calibration(second, "second")
    if first.pair_offsets or second.pair_offsets:
        raise UnanswerableError(
            "only delays of tags can be compared, and one of the calibrations has constants of pairs"
        )
    known = [{t for t in c.delays_ns if t in c.sides or not np.isinf(c.delays_std_ns.get(t, np.nan))} for c in both]
    common = sorted(known[0] & known[1])
    if len(common) < 2:
        raise UnanswerableError(
            f"{len(common)} tags have determined delays in both calibrations; a comparison needs at least two"
        )
    stated = [t for t in common if all(_is_stated(c, t) for c in both)]
    tags = stated if len(stated) > 1 else common
    moves = [_reference_shift(first, second, common, name) for name in DEPENDENCES]
    moved_ns, moved_ns2 = (np.sum(of_all, axis=0) for of_all in zip(*moves, strict=True))
    delta = np.array([second.delays_ns[t] - first.delays_ns[t] for t in common]) - moved_ns
    loose = loose_shifts(both, common)
    rows = np.isin(common, tags)
    covariance = np.eye(len(tags))
    if len(stated) > 1:
        covariance = sum(c.covariance_ns2(stated) for c in both) + 1e-12 * np.eye(len(stated))
        covariance = covariance + moved_ns2[np.ix_(rows, rows)]
    # Subtract the weighted least-squares estimate of the shifts; each takes one degree of freedom.
    precision = np.linalg.inv(covariance)
    of_loose = np.linalg.pinv(loose[rows].T @ precision @ loose[rows], hermitian=True)
    taken = of_loose @ loose[rows].T @ precision @ delta[rows]
    left = delta - loose @ taken
    degrees = len(stated) - int(np.linalg.matrix_rank(loose[rows]))
    std_ns = dict.fromkeys(common, np.nan)
    score = probability = np.nan
    if degrees > 0:
        score = float(left[rows] @ precision @ left[rows])
        probability = float(chdtrc(degrees, score))
        std = np.sqrt(np.maximum(np.diag(covariance - loose[rows] @ of_loose @ loose[rows].T), 0))
        std_ns |= dict(zip(stated, std.tolist(), strict=True))
    low = max(first.bias_curve.range[0], second.bias_curve.range[0])
    high = min(first.bias_curve.range[1], second.bias_curve.range[1])
    grid = np.linspace(low, max(high, low + 1e-9), 400)
    curves = second.bias_curve(grid) - first.bias_curve(grid)
    return CalibrationComparison(
        difference_ns=dict(zip(common, left.tolist(), strict=True)),
        std_ns=std_ns,
        offset_m=float(taken[0]) * 1e-9 * SPEED_OF_LIGHT - float(curves.mean()),
        curve_rms_m=float(curves.std()),
        chi_square=score,
        degrees=max(degrees, 0),
        probability=probability,
        **_apart(first, second, common),
        only_first=tuple(sorted(set(first.delays_ns) - set(common))),
        only_second=tuple(sorted(set(second.delays_ns) - set(common))),
    )


DEPENDENCES: Final = {
    "patterns": ("pattern over direction", "directions", "pattern"),
    "temperatures": ("slope over temperature", "temperatures", "temperature"),
}
"""Name, plural of the reference, and setting of the fit of each dependence of delays, by the field of a calibration."""


def _reference_shift(first: Calibration, second: Calibration, tags: list[int], name: str) -> tuple[Floats, Floats]:
    """Return the change of delays (tags,) from the reference of the first calibration to that of the second, in ns.

    The reference is the average direction or the reference temperature. The second value is the covariance (tags, tags)
    of the changes. Raises `UnanswerableError` if a tag has the dependence in only one calibration.
    """
    centres = {tag: one.centre for one in getattr(first, name) for tag in one.tags}
    later = {tag for one in getattr(second, name) for tag in one.tags}
    if unlike := [tag for tag in tags if (tag in centres) != (tag in later)]:
        what, where, setting = DEPENDENCES[name]
        raise UnanswerableError(
            f"tags {first_few(map(str, unlike))} have a {what} in only one of the calibrations, so their delays refer "
            f"to different {where}; fit both with the same `{setting}`"
        )
    moved_ns, moved_ns2 = np.zeros(len(tags)), np.zeros((len(tags),) * 2)
    for one in getattr(second, name):
        own = np.isin(tags, one.tags)[:, None]
        # A delay d changes a range by -c d / 2, so a change of a range by x is one of the delay by -2 x / c.
        away = 2e9 / SPEED_OF_LIGHT * own * (np.array([centres.get(t, one.centre) for t in tags]) - one.centre)
        moved_ns = moved_ns + away @ np.array(one.coefficients_m)
        moved_ns2 = moved_ns2 + away @ np.array(one.covariance_m2) @ away.T
    return moved_ns, moved_ns2


def _apart(first: Calibration, second: Calibration, tags: list[int]) -> dict[str, float]:
    """Return the rms of the difference of patterns over direction, and the probability of a larger one by chance."""
    apart, covariance = np.zeros((len(tags), HARMONICS)), np.zeros((len(tags) * HARMONICS,) * 2)
    members = np.zeros(len(tags), dtype=bool)
    for sign, calibration in ((-1, first), (1, second)):
        for pattern in calibration.patterns:
            own = np.isin(tags, pattern.tags)
            members |= own
            apart += sign * np.outer(own, pattern.coefficients_m)
            covariance += np.kron(np.outer(own, own), np.array(pattern.covariance_m2))
    if not members.any():
        return {"pattern_rms_m": np.nan, "pattern_probability": np.nan}
    score = float(apart.ravel() @ np.linalg.pinv(covariance, hermitian=True) @ apart.ravel())
    probability = float(chdtrc(np.linalg.matrix_rank(covariance, hermitian=True), score))
    rms_m = float(np.sqrt(np.mean(np.sum(apart**2, axis=1)[members])))
    return {"pattern_rms_m": rms_m, "pattern_probability": probability}


def loose_shifts(calibrations: Iterable[Calibration], tags: list[int]) -> Floats:
    """Return the shifts of delays (tags, k) that are removed before a comparison: of all tags, and along each split."""
    splits = [sides for calibration in calibrations for sides in calibration.undetermined_splits]
    along = [np.isin(tags, first) * 1.0 - np.isin(tags, second) for first, second in splits]
    return np.column_stack([np.ones(len(tags)), *along])


def _is_stated(calibration: Calibration, tag: int) -> bool:
    """Return whether a calibration states the standard error of a delay."""
    covered = calibration.uncertainty is not None and tag in calibration.uncertainty.tags
    return covered or np.isfinite(calibration.delays_std_ns.get(tag, np.nan))
