"""Which means are reflected: a row's error is that of its pair, or with a small chance a detour that lasts.

A detour lengthens the way of one pair in one arrangement by N(0.3 m, 0.25 m), of which what is below zero hardly
counts: nothing is shorter than the straight way, but for a gross error in a hundred. What share of rows has one is not
known, a beta distribution beforehand. For given marks all is normal, so the likelihood of every other choice of marks
that differs in one or two rows follows from one matrix, times the probability of each marked row that its detour is
positive; a search takes the best of them until none is better. Choices nearly as likely as the best are kept with their
weights (Occam's window: Madigan and Raftery, Journal of the American Statistical Association, 1994), so that intervals
say when it is open which of two pairs is reflected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import betaln, ndtr

from calib.surveys.network import DETOUR_M, DETOUR_STD_M, Case, Network
from uwblink.arrays import Bools, Floats

REFLECTED, STRAIGHT = 1.0, 30.0
"""Rows with and without a detour that the share of them is worth before any data."""

SHORTER_SHARE = 0.01
"""Share of rows with a gross error that are shorter than the straight way: no detour is."""

MAX_WORSE = 2 * math.log(20.0)
"""By how much -2 log likelihood a choice may be worse than the best and still count."""

MAX_FIRST_CHANGES = 24
"""How many single changes, the best ones, are looked at together with a second one."""


@dataclass(frozen=True, slots=True)
class Marks:
    """Which rows are `marked` (n,), the inverse covariance (n, n) of rows under these marks, that times deviations."""

    marked: Bools
    inverse: Floats
    pull: Floats
    mine: Bools

    @classmethod
    def at(cls, network: Network, x: Floats, case: Case, only: int | None = None) -> Marks:
        """Return the marks of a case, linear about unknowns (p,); those of `only` one arrangement can change."""
        here = network.at(x, case, only)
        left = here.left + here.jacobian[:, here.free] @ here.away[here.free]
        weighed = here.jacobian / here.std[:, None] ** 2
        inverse = np.diag(here.std**-2) - weighed @ here.covariance() @ weighed.T
        count = len(case.marks)
        return cls(case.marks, inverse[:count, :count], (inverse @ left)[:count], network.rows_of(only))

    def flipped(self, row: int) -> Marks:
        """Return these marks with that of one row changed (by the formula of Sherman and Morrison)."""
        sign = -1.0 if self.marked[row] else 1.0
        column, variance = self.inverse[:, row], sign * DETOUR_STD_M**2
        pull = self.pull - sign * DETOUR_M * column
        gain = variance / (1 + variance * column[row])
        marked = self.marked.copy()
        marked[row] ^= True
        return replace(
            self,
            marked=marked,
            inverse=self.inverse - gain * np.outer(column, column),
            pull=pull - gain * pull[row] * column,
        )

    def penalties(self) -> Floats:
        """Return -2 log of how much less likely each row (n,) is for its detour being positive, if it is marked."""
        own = np.diag(self.inverse)
        grown = np.where(self.marked, 1.0, 1 + DETOUR_STD_M**2 * own)
        own, pull = own / grown, (self.pull - np.where(self.marked, 0.0, DETOUR_M) * own) / grown
        mean, variance = DETOUR_M + DETOUR_STD_M**2 * pull, DETOUR_STD_M**2 - DETOUR_STD_M**4 * own
        longer = ndtr(mean / np.sqrt(np.maximum(variance, 1e-12)))
        return np.asarray(-2 * np.log((longer + SHORTER_SHARE) / (ndtr(DETOUR_M / DETOUR_STD_M) + SHORTER_SHARE)))

    def changes(self, *, signed: bool = True) -> Floats:
        """Return what a change of each mark (n,) adds to -2 log likelihood, with the row's penalty if `signed`."""
        sign, own = np.where(self.marked, -1.0, 1.0), np.diag(self.inverse)
        variance, mean = sign * DETOUR_STD_M**2, sign * DETOUR_M
        grown = np.maximum(1 + variance * own, 1e-12)
        away = self.pull - mean * own
        found = np.log(grown) - 2 * mean * self.pull + mean**2 * own - variance * away**2 / grown
        count, rows = int(self.marked.sum()), len(self.marked)
        share = np.array([unlikely(min(max(count + step, 0), rows), rows) for step in (-1, 0, 1)])
        found += share[1 + sign.astype(int)] - share[1]
        found += sign * self.penalties() if signed else 0.0
        return np.where(self.mine, found, math.inf)

    def searched(self, steps: int = 40) -> Bools:
        """Return the marks (n,) after changes of one or two rows at a time, those that gain most, until none gains."""
        here = self
        for _ in range(steps):
            singles = here.changes()
            first = int(np.argmin(singles))
            best, chosen = float(singles[first]), here.flipped(first)
            for row in np.argsort(singles, kind="stable")[:MAX_FIRST_CHANGES].tolist():
                if not math.isfinite(singles[row]):
                    break
                after = here.flipped(row)
                doubles = after.changes()
                doubles[row] = math.inf
                second = int(np.argmin(doubles))
                if singles[row] + doubles[second] < best - 1e-9:
                    best, chosen = float(singles[row] + doubles[second]), after.flipped(second)
            if best > -1e-6:
                break
            here = chosen
        return here.marked

    def window(self) -> tuple[list[Bools], Floats]:
        """Return these marks and those, one or two rows away, that lie in the window, with weights that sum to 1."""
        kept: list[tuple[Bools, float]] = [(self.marked, float(self.penalties()[self.marked].sum()))]
        singles, plain = self.changes(), self.changes(signed=False)
        seen = np.zeros(len(singles), dtype=bool)
        for row in np.argsort(singles, kind="stable")[:MAX_FIRST_CHANGES].tolist():
            after = self.flipped(row)
            if singles[row] < MAX_WORSE:
                kept.append((after.marked, plain[row] + float(after.penalties()[after.marked].sum())))
            doubles, more = after.changes(), after.changes(signed=False)
            seen[row] = True
            for second in np.flatnonzero((singles[row] + doubles < MAX_WORSE) & ~seen).tolist():
                last = after.flipped(second)
                value = plain[row] + more[second] + float(last.penalties()[last.marked].sum())
                kept.append((last.marked, value))
        values = np.array([value for _, value in kept])
        weight = np.exp(-0.5 * (values - values.min()))
        return [marks for marks, _ in kept], weight / weight.sum()


def unlikely(count: int, rows: int) -> float:
    """Return -2 log of the probability that just these rows are reflected, `count` of them, whatever the share."""
    return -2 * float(betaln(REFLECTED + count, STRAIGHT + rows - count) - betaln(REFLECTED, STRAIGHT))
