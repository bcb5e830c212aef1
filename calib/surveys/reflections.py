"""Which means are reflected: a row's error is its pair's error, or with a small probability a detour that lasts.

A detour lengthens the path of one pair in one arrangement by N(0.3 m, 0.25 m); negative values have a small weight,
because only gross errors (one in a hundred) are shorter than the straight path. The share of rows with a detour is
unknown, with a beta distribution as prior. For given marks all errors are normal. So the likelihood of every choice of
marks that differs in one or two rows follows from one matrix, times the probability that the detour of each marked row
is positive; a search takes the best change until none is better. Choices nearly as likely as the best are kept with
their weights (Occam's window: Madigan and Raftery, Journal of the American Statistical Association, 1994), so that
intervals include the uncertainty about which of two pairs is reflected.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import betaln, ndtr

from calib.surveys.network import DETOUR_MEAN_M, DETOUR_STD_M, Case, Linear, Network
from uwblink.arrays import Bools, Floats

PRIOR_REFLECTED, PRIOR_DIRECT = 1.0, 30.0
"""Number of rows with and without a detour that the prior of their share counts for: 3 % are reflected. Half or twice
of either moves delays by 0.2 standard errors (`python -m benchmarks.constants`)."""

SHORTER_SHARE = 0.01
"""Share of rows with a gross error, shorter than the straight path, which no detour explains. It keeps logarithms
finite."""


MAX_FIRST_CHANGES = 24
"""Number of best single changes that are tried together with a second one: half or twice as many do not change results
(`python -m benchmarks.constants`)."""


@dataclass(frozen=True)
class Marks:
    """Which rows are `marked` (n,), the inverse covariance (n, n) of rows under these marks, and that times deviations.

    `plain` is -2 log likelihood relative to other marks that were made from the same, without `penalties`.
    """

    marked: Bools
    inverse: Floats
    pull: Floats
    plain: float = 0.0

    @classmethod
    def at(cls, network: Network, x: Floats, case: Case) -> Marks:
        """Return the marks of a case, linear about unknowns (p,)."""
        here, count = Linear(network, x, case), len(case.marks)
        rows, std = here.jacobian[:count], here.std[:count]
        inverse = (np.eye(count) - rows @ here.covariance @ rows.T) / std[:, None] / std
        return cls(case.marks, inverse, (here.left[:count] - rows @ here.step) / std)

    @property
    def sign(self) -> Floats:
        """The change of the number of marks by a change of each mark (n,)."""
        return np.where(self.marked, -1.0, 1.0)

    def penalties(self) -> Floats:
        """Return -2 log of the probability that the detour of each row (n,) is positive, if it is marked."""
        own = np.diag(self.inverse)
        grown = np.where(self.marked, 1.0, 1 + DETOUR_STD_M**2 * own)
        own, pull = own / grown, (self.pull - np.where(self.marked, 0.0, DETOUR_MEAN_M) * own) / grown
        mean, variance = DETOUR_MEAN_M + DETOUR_STD_M**2 * pull, DETOUR_STD_M**2 - DETOUR_STD_M**4 * own
        longer = ndtr(mean / np.sqrt(np.maximum(variance, 1e-12)))
        return np.asarray(-2 * np.log((longer + SHORTER_SHARE) / (ndtr(DETOUR_MEAN_M / DETOUR_STD_M) + SHORTER_SHARE)))

    @cached_property
    def plain_changes(self) -> Floats:
        """What a change of each mark (n,) adds to -2 log likelihood, without penalties."""
        sign, own = self.sign, np.diag(self.inverse)
        grown = np.maximum(1 + sign * DETOUR_STD_M**2 * own, 1e-12)
        away = self.pull - sign * DETOUR_MEAN_M * own
        found = np.log(grown) - 2 * sign * DETOUR_MEAN_M * self.pull + DETOUR_MEAN_M**2 * own
        found -= sign * DETOUR_STD_M**2 * away**2 / grown
        count, rows = int(self.marked.sum()), len(self.marked)
        share = np.array([deviance_of_count(min(max(count + step, 0), rows), rows) for step in (-1, 0, 1)])
        return np.asarray(found + share[1 + sign.astype(int)] - share[1])

    def changes(self) -> Floats:
        """Return what a change of each mark (n,) adds to -2 log likelihood, with the row's penalty."""
        return np.asarray(self.plain_changes + self.sign * self.penalties())

    def with_change(self, row: int) -> Marks:
        """Return these marks with the mark of one row changed (by the formula of Sherman and Morrison)."""
        sign, column = self.sign[row], self.inverse[:, row]
        pull = self.pull - sign * DETOUR_MEAN_M * column
        gain = sign * DETOUR_STD_M**2 / (1 + sign * DETOUR_STD_M**2 * column[row])
        return Marks(
            np.where(np.arange(len(column)) == row, ~self.marked, self.marked),
            self.inverse - gain * np.outer(column, column),
            pull - gain * pull[row] * column,
            self.plain + float(self.plain_changes[row]),
        )

    def _neighbours(self) -> Iterator[tuple[Marks, Floats]]:
        """Yield these marks and the best ones with one row changed, with the effect of one more change on each."""
        changes = self.changes()
        yield self, changes
        for row in np.argsort(changes, kind="stable")[:MAX_FIRST_CHANGES].tolist():
            after = self.with_change(row)
            more = changes[row] + after.changes()
            more[row] = math.inf
            yield after, more

    def search(self) -> Bools:
        """Return the marks (n,) after changes of one or two rows at a time, always the best ones, until none is an
        improvement.
        """
        here = self
        for _ in range(40):
            after, more = min(here._neighbours(), key=lambda one: float(one[1].min()))
            if more.min() > -1e-6:
                break
            here = after.with_change(int(np.argmin(more)))
        return here.marked

    def window(self) -> tuple[list[Bools], Floats]:
        """Return these marks and those within one or two changes that lie in the window, with weights that sum to 1."""
        near = {self.marked.tobytes(): self}
        for after, more in self._neighbours():
            # Choices with less than a twentieth of the best weight are omitted.
            for row in np.flatnonzero(more < 2 * math.log(20.0)).tolist():
                last = after.with_change(row)
                near[last.marked.tobytes()] = last
        kept = list(near.values())
        value = np.array([one.plain + float(one.penalties()[one.marked].sum()) for one in kept])
        weight = np.exp(-0.5 * (value - value.min()))
        return [one.marked for one in kept], weight / weight.sum()


def deviance_of_count(count: int, rows: int) -> float:
    """Return -2 log of the probability that exactly these rows are reflected, `count` of them, integrated over the
    share.
    """
    return -2 * float(
        betaln(PRIOR_REFLECTED + count, PRIOR_DIRECT + rows - count) - betaln(PRIOR_REFLECTED, PRIOR_DIRECT)
    )
