"""The error model by group: by bins of power, by pair, or for one listener."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimator.optimize import maximize
from calib.estimator.range_model import DETOUR_M, DETOUR_WORTH, LEAST_DETOUR_M, LONG_ODDS, ODDS
from calib.estimator.range_rows import RESIDUAL, Mixture, Part, RangeRows
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown
from calib.range_errors.densities import LONG_FACTOR, LongDetours
from calib.range_errors.density import OUTLIERS_OVER_M, error_slopes
from calib.spread import robust_spread
from uwblink.arrays import Floats


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

    The density is that of `calib.range_errors.density`. Centre and noise belong to a group; shares and detours of
    groups scatter about common values, as those of pairs do in a fit (`RangeModel.error_model`).
    """
    members = [own[:: -(-len(own) // most)] for own in groups]
    count, size = len(members), np.array([len(own) for own in members])
    error_m, group = np.concatenate(members), np.repeat(np.arange(count), size)
    middle = np.array([np.median(own) for own in members])
    spread = np.maximum([robust_spread(own) for own in members], 1e-6)
    zero = np.zeros(count)
    # Parameter, kind, start, prior; a parameter is the sum of its kinds.
    table = (
        (RESIDUAL, "centre", zero, Prior.of_deviation(100.0)),
        ("noise", "noise", np.log(spread), Prior.of_deviation(2.0, np.log(spread))),
        ("odds", "odds level", ODDS, Prior.of_deviation(2.0, ODDS)),
        ("odds", "odds", zero, Prior.of_spread(0.7, 0.03, 2.0)),
        ("detour", "detour level", np.log(DETOUR_M), Prior.of_deviation(DETOUR_WORTH**-0.5, np.log(DETOUR_M))),
        ("detour", "detour", zero, Prior.of_spread(0.2, 0.03, 0.7)),
        ("outliers", "outliers", -6.0, Prior.of_deviation(3.0, -6.0)),
        ("least", "least detour", np.log(LEAST_DETOUR_M), Prior.of_deviation(2**0.5, np.log(LEAST_DETOUR_M))),
        ("long", "long detours", LONG_ODDS, Prior.of_deviation(1.0, LONG_ODDS)),
    )
    unknowns, parts = [], []
    for parameter, kind, start, prior in table:
        first = np.atleast_1d(start).astype(np.float64)
        unknowns.append(Unknown(kind=kind, names=("",) * len(first), start=first, priors=(prior,)))
        columns = group[:, None] if np.ndim(start) else np.zeros((1, 1), dtype=np.int64)
        weight = np.full((len(group), 1), -1.0) if parameter == RESIDUAL else None
        parts.append(Part(parameter=parameter, kind=kind, columns=columns, values=weight))
    layout = Layout(tuple(unknowns))
    rows = RangeRows.of(error_m - middle[group], group, parts, Mixture(), layout)
    found = maximize([rows], Priors(layout), layout.start())
    values = rows.values(found.x)
    each = error_slopes(values.pop(RESIDUAL), values, span_m=OUTLIERS_OVER_M)
    long = LongDetours(share=float(1 / (1 + np.exp(-found.of("long detours")[0]))), factor=LONG_FACTOR)
    of_centre = layout.where["centre"]
    return GroupedErrors(
        centre_m=middle + found.of("centre"),
        centre_std_m=np.sqrt(np.diag(found.covariance[of_centre, of_centre])),
        sigma_m=np.exp(found.of("noise")),
        reflected=np.bincount(group, each.reflected) / size,
        detour_m=np.exp(found.of("least detour")[0])
        + long.mean * np.exp(found.of("detour level") + found.of("detour")),
        outliers=np.bincount(group, 1 - each.inlier) / size,
    )
