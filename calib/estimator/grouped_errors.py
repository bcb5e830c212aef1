"""The error model by group: by bins of power, by pair, or for one listener."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from calib.estimator.error_unknowns import error_unknowns
from calib.estimator.optimize import maximize
from calib.estimator.range_rows import RESIDUAL, Mixture, Part, RangeRows
from calib.estimator.unknowns import Layout, Prior, Priors, Unknown
from calib.range_errors.densities import LONG_FACTOR, LongDetours
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

    The density is that of `calib.range_errors.density`. Each group has a centre and a noise; shares and detours of
    groups scatter about common values, as those of pairs do in a fit (`error_unknowns`).
    """
    members = [own[:: -(-len(own) // most)] for own in groups]
    count, size = len(members), np.array([len(own) for own in members])
    error_m, group = np.concatenate(members), np.repeat(np.arange(count), size)
    middle = np.array([np.median(own) for own in members])
    spread = np.maximum([robust_spread(own) for own in members], 1e-6)
    names = tuple(map(str, range(count)))
    unknowns, parts = error_unknowns(float(np.median(spread)), names, group, "group")
    # Groups need not be alike in their noise: each has its own, about no common level.
    unknowns = [unknown for unknown in unknowns if not unknown.kind.startswith("noise")]
    parts = [part for part in parts if part.kind != "noise level"]
    log_spread = np.log(spread)
    wide = (Prior.of_deviation(2.0, log_spread),)
    unknowns.append(Unknown(kind="noise of group", names=names, start=log_spread, priors=wide))
    centre = Unknown(kind="centre", names=names, start=np.zeros(count), priors=(Prior.of_deviation(100.0),))
    parts.append(Part(parameter=RESIDUAL, kind="centre", columns=group[:, None], values=np.full((len(group), 1), -1.0)))
    layout = Layout((centre, *unknowns))
    rows = RangeRows.of(error_m - middle[group], group, parts, Mixture(), layout)
    found = maximize([rows], Priors(layout), layout.start())
    each = rows.error_slopes(found.x, ())
    long = LongDetours(share=float(1 / (1 + np.exp(-found.of("long detours")[0]))), factor=LONG_FACTOR)
    of_centre = layout.where["centre"]
    return GroupedErrors(
        centre_m=middle + found.of("centre"),
        centre_std_m=np.sqrt(np.diag(found.covariance[of_centre, of_centre])),
        sigma_m=np.exp(found.of("noise of group")),
        reflected=np.bincount(group, each.reflected) / size,
        detour_m=np.exp(found.of("least detour")[0])
        + long.mean * np.exp(found.of("detour level") + found.of("detour of group")),
        outliers=np.bincount(group, 1 - each.inlier) / size,
    )
