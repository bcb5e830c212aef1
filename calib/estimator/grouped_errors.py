"""The parameters of the error model as unknowns: levels that all ranges share, and deviations of groups.

Groups are the pairs of a fit, or other groups such as bins of power or listeners (`fit_grouped_errors`). The log odds
of a reflection also depend on features of receptions (`ReflectionFeatures`), whose slopes are fitted with all other
unknowns: no range is labelled as reflected beforehand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import expit, logit

from calib.calibration.error_model import ErrorModel, FeatureSlope
from calib.data.ranges import FEATURES, Ranges
from calib.estimator.optimize import maximize
from calib.estimator.range_rows import Mixture, Part, RangeRows, block_of
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown
from calib.spread import robust_spread
from uwblink.arrays import Floats, Ints

NOISE_M, NOISE_WORTH = 0.06, 20.0
"""Prior of the noise of a range, and the number of ranges that it counts for. A stamp of a DW1000 has 0.15 ns of noise
in the open (its user manual, 8.3), which gives 3 to 10 cm. Half or twice the number moves delays of worlds by less
than 0.01 standard errors (`python -m benchmarks.constants`)."""

DETOUR_M, DETOUR_WORTH, LEAST_DETOUR_M = 0.35, 5.0, 0.03
"""Prior of the mean of exponential detours, the number of reflections that it counts for, and the least detour
(published detours are 0.1 to 0.5 m: MILUV, STAR-loc). Half or twice the number, or the least detour, moves delays of
worlds by 0.02 standard errors (`python -m benchmarks.constants`)."""

SHARED_LEVELS = {
    "noise": ("noise level", np.log(NOISE_M), (2 * NOISE_WORTH) ** -0.5),
    "odds": ("odds level", -2.2, 2.0),  # a reflection: one range in ten; 1.5 to 45 % within one standard deviation
    "detour": ("detour level", np.log(DETOUR_M), DETOUR_WORTH**-0.5),
    "least": ("least detour", np.log(LEAST_DETOUR_M), 2**0.5),
    "outliers": ("outliers", -6.0, 3.0),
    "long": ("long detours", -1.1, 1.0),  # of the longer kind: one reflection in four; 11 to 48 %
}
"""Kind of the unknown that all ranges share, centre and standard deviation of its prior, by parameter."""

STARTS = {"detour": np.log(1.0), "least": np.log(0.01), "long": 2.0}
"""Start values of searches that differ from the centres of priors: detours longer than most, and no short detour. From
these values 21 flights of six simulated rooms and six kinds of drawn errors ended at or near the best likelihood; from
the centres some ended with a log likelihood lower by 50 to 900, with long reflections taken for outliers.
"""

SCATTER = {"noise": (0.1, 0.01, 2.0), "odds": (0.7, 0.03, 2.0), "detour": (0.2, 0.03, 0.7)}
"""Standard deviation of groups about these: start value, and bounds of the estimate.

Half or twice of all of these moves delays of worlds by 0.11 standard errors (`python -m benchmarks.constants`).
"""


def error_unknowns(
    spread_m: float, names: tuple[str, ...], group: Ints, whose: str = "pair"
) -> tuple[list[Unknown], list[Part]]:
    """Return the parameters of the error model as unknowns, and the parts of ranges that depend on them.

    `group` (n,) is the number of each range's group among `names`, `spread_m` a first guess of the noise.
    """
    everyone, own = np.zeros((1, 1), dtype=np.int64), group[:, None]
    starts = {name: centre for name, (_, centre, _) in SHARED_LEVELS.items()}
    starts |= STARTS | {"noise": np.log(0.9 * spread_m)}
    unknowns = [
        logarithms(kind, ("",), np.array([starts[name]]), Prior.of_deviation(deviation, centre))
        for name, (kind, centre, deviation) in SHARED_LEVELS.items()
    ]
    each = np.zeros(len(names))
    unknowns += [
        logarithms(f"{name} of {whose}", names, each, Prior.of_spread(*spread)) for name, spread in SCATTER.items()
    ]
    parts = [Part(parameter=name, kind=kind, columns=everyone) for name, (kind, *_) in SHARED_LEVELS.items()]
    parts += [Part(parameter=name, kind=f"{name} of {whose}", columns=own) for name in SCATTER]
    return unknowns, parts


def logarithms(kind: str, names: tuple[str, ...], start: Floats, *priors: Prior) -> Unknown:
    """Return unknowns that are logarithms, or log odds."""
    return Unknown(kind=kind, names=names, start=start, priors=priors, logarithm=True)


def scattered(
    kind: str,
    names: tuple[str, ...],
    spread: tuple[float, float, float],
    freedom: float = np.inf,
    unit: str | None = None,
    members: Floats | None = None,
) -> Unknown:
    """Return unknowns about zero whose standard deviation is estimated: its first value and bounds are `spread`."""
    prior = replace(Prior.of_spread(*spread, freedom, unit), members=members)
    return Unknown(kind=kind, names=names, start=np.zeros(len(names)), priors=(prior,))


UNIT_OF_PRIOR = np.array([3.0, 2.0])
"""Changes of `FEATURES` (dB, taps) by which the odds of a reflection may change by a factor of e: the standard
deviation of the prior of a slope is 1 for each. A judgement; the chip maker regards 6 dB as a sign of a reflection
(APS006, part 3), which is two of these changes."""


@dataclass(frozen=True, kw_only=True)
class ReflectionFeatures:
    """The features of ranges that vary, by `number` among `FEATURES` (k,): in `values` (n, k + 1) units from `centre`.

    Unknown features are 0; the last column is 1 if all features are known. `bounds` (2, k) are the least and the
    largest.
    """

    number: list[int]
    centre: Floats
    bounds: Floats
    values: Floats

    @classmethod
    def of(cls, ranges: Ranges) -> ReflectionFeatures | None:
        """Return the features of ranges, None where none varies."""
        columns = (ranges.features[:, k].astype(np.float64) for k in range(len(FEATURES)))
        varied = {k: one for k, one in enumerate(columns) if len(np.unique(one[np.isfinite(one)])) > 1}
        if not varied:
            return None
        found = np.column_stack(list(varied.values()))
        centre, bounds = np.nanmean(found, axis=0), np.array([np.nanmin(found, axis=0), np.nanmax(found, axis=0)])
        unknown = ~np.isfinite(found).any(axis=1)
        values = np.column_stack([np.nan_to_num((found - centre) / UNIT_OF_PRIOR[[*varied]]), unknown])
        return cls(number=[*varied], centre=centre, bounds=bounds, values=values)

    def block(self) -> tuple[Unknown, Part]:
        """Return the slopes of the log odds as unknowns, and the part that ranges have in them."""
        names = (*(FEATURES[k] for k in self.number), "unknown")
        unknown = logarithms("odds of feature", names, np.zeros(len(names)), Prior.of_deviation(1.0))
        return block_of(unknown, np.arange(len(names))[None], self.values, parameter="odds")

    def state(self, stated: ErrorModel, slopes: Floats, share: Floats) -> ErrorModel:
        """Return an error model with the features whose `slopes` (k + 1,) were fitted.

        `share` (n,) are the shares of reflections by the model without features, for features at their centre. The new
        model's shares hold for ranges without known features, with the same mean over all ranges.
        """
        base, mean = logit(share), float(np.mean(expit(logit(share) + self.values @ slopes)))
        shift = float(brentq(lambda more: np.mean(expit(base + more)) - mean, -50.0, 50.0))
        features = {
            FEATURES[k]: FeatureSlope(float(slope / UNIT_OF_PRIOR[k]), float(centre), (float(low), float(high)))
            for k, slope, centre, low, high in zip(self.number, slopes, self.centre, *self.bounds, strict=False)
        }
        tail_share = tuple(np.clip(expit(logit(stated.tail_share) + shift), 1e-4, 1 - 1e-4).tolist())
        return replace(stated, tail_share=tail_share, features=features, known_log_odds=-shift)


@dataclass(frozen=True, slots=True, kw_only=True)
class GroupedErrors:
    """The error model by group (groups,): centre and standard deviation of direct ranges, reflections, outliers.

    `centre_std_m` is the standard error of the centre for independent errors; `reflected` and `outliers` are shares of
    all ranges, `detour_m` is the mean detour of reflections.
    """

    centre_m: Floats
    centre_std_m: Floats
    sigma_m: Floats
    reflected: Floats
    detour_m: Floats
    outliers: Floats


def fit_grouped_errors(groups: Sequence[Floats], most: int = 20_000) -> GroupedErrors:
    """Return the maximum likelihood error model of groups of errors in metres; larger groups are thinned evenly to
    `most`.

    The density is that of `calib.range_errors.densities`. Each group has a centre and a noise; shares and detours of
    groups vary around common values, as for pairs in a fit (`error_unknowns`).
    """
    members = [own[:: -(-len(own) // most)] for own in groups]
    count, size = len(members), np.array([len(own) for own in members])
    error_m, group = np.concatenate(members), np.repeat(np.arange(count), size)
    middle = np.array([np.median(own) for own in members])
    spread = np.maximum([robust_spread(own) for own in members], 1e-6)
    names = tuple(map(str, range(count)))
    unknowns, parts = error_unknowns(float(np.median(spread)), names, group, "group")
    # Each group has its own noise, without a common level.
    unknowns = [unknown for unknown in unknowns if not unknown.kind.startswith("noise")]
    parts = [part for part in parts if part.kind != "noise level"]
    log_spread = np.log(spread)
    unknowns.append(logarithms("noise of group", names, log_spread, Prior.of_deviation(2.0, log_spread)))
    centre, of_centre = block_of(
        Unknown(kind="centre", names=names, start=np.zeros(count), priors=(Prior.of_deviation(100.0),)),
        group[:, None],
        np.full((len(group), 1), -1.0),
    )
    layout = Layout((centre, *unknowns))
    rows = RangeRows.of(error_m - middle[group], group, [*parts, of_centre], Mixture(), layout)
    found = maximize([rows], Priors(layout), layout.start())
    each = rows.error_slopes(found.x, ())
    which = layout.where["centre"]
    return GroupedErrors(
        centre_m=middle + found.of("centre"),
        centre_std_m=np.sqrt(np.diag(found.covariance[which, which])),
        sigma_m=np.exp(found.of("noise of group")),
        reflected=np.bincount(group, each.reflected) / size,
        detour_m=np.exp(found.of("least detour")[0]) + np.exp(found.of("detour level") + found.of("detour of group")),
        outliers=np.bincount(group, 1 - each.inlier) / size,
    )
