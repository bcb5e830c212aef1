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
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.surveys.network import DETOUR_M, DETOUR_STD_M, Network
from uwblink.arrays import Bools, Floats

SHARE_REFLECTED: Final = 1.0
SHARE_STRAIGHT: Final = 30.0
"""Rows with and without a detour that the share of them is worth before any data."""

SHORTER: Final = 0.01
"""Share of rows with a gross error that are shorter than the straight way: no detour is."""

WINDOW: Final = 2 * math.log(20.0)
"""By how much -2 log likelihood a choice may be worse than the best and still count."""

MOST_STEPS: Final = 40
MOST_CHOICES: Final = 60


@dataclass(frozen=True, slots=True)
class Choices:
    """Choices of reflected rows (k, n), and their weights (k,), which sum to 1; the first is the network's own."""

    marks: Bools
    weight: Floats

    @property
    def chance(self) -> Floats:
        """How probable it is of each row (n,) that it is reflected."""
        return np.asarray(self.weight @ self.marks)


def unlikely(count: int, rows: int) -> float:
    """Return -2 log of the probability that just these rows are reflected, `count` of them, whatever the share."""
    a, b = SHARE_REFLECTED + count, SHARE_STRAIGHT + rows - count
    both = math.lgamma(SHARE_REFLECTED) + math.lgamma(SHARE_STRAIGHT) - math.lgamma(SHARE_REFLECTED + SHARE_STRAIGHT)
    return -2 * (math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b) - both)


def too_short(mean_m: Floats, variance_m2: Floats) -> Floats:
    """Return -2 log of how much less likely detours (n,), known with a mean and a variance, are for being positive."""
    from scipy.special import ndtr

    longer = ndtr(mean_m / np.sqrt(np.maximum(variance_m2, 1e-12)))
    return np.asarray(-2 * np.log((longer + SHORTER) / (ndtr(DETOUR_M / DETOUR_STD_M) + SHORTER)))


def of_marked(network: Network, x: Floats, std_m: Floats, curve_std_m: float) -> float:
    """Return the sum of `too_short` over the marked rows of a network, linear about `x`."""
    if not network.reflected.any():
        return 0.0
    one = _Linear.of(network, x, std_m, curve_std_m)
    return float(one.penalties()[one.marks].sum())


def searched(network: Network, x: Floats, std_m: Floats, curve_std_m: float) -> Bools:
    """Return which means (n,) are likeliest reflected, from the marks of the network on; linear about `x`."""
    return _Linear.of(network, x, std_m, curve_std_m).searched().marks


def choices(network: Network, x: Floats, std_m: Floats, curve_std_m: float) -> Choices:
    """Return the marks of the network and those others that are nearly as likely."""
    return _Linear.of(network, x, std_m, curve_std_m).window()


@dataclass(slots=True)
class _Linear:
    """Marks (n,), the inverse covariance of rows (n, n) under them, and that times the rows' deviations (n,)."""

    marks: Bools
    inverse: Floats
    pull: Floats

    @classmethod
    def of(cls, network: Network, x: Floats, std_m: Floats, curve_std_m: float) -> _Linear:
        jacobian = network.jacobian(x)
        deviation = network.residuals(x) + jacobian @ (x - network.centre())
        weighed = jacobian / std_m[:, None] ** 2
        spread = np.linalg.inv(jacobian.T @ weighed + network.prior(curve_std_m))
        inverse = np.diag(std_m**-2) - weighed @ spread @ weighed.T
        pull = inverse @ deviation
        rows = len(network.means)
        return cls(network.reflected.copy(), inverse[:rows, :rows].copy(), pull[:rows].copy())

    def searched(self) -> _Linear:
        """Change one or two marks at a time, those that gain most, until nothing gains."""
        for _ in range(MOST_STEPS):
            single, double = self._changes()
            one, two = int(np.argmin(single)), int(np.argmin(double))
            if min(single[one], double.flat[two]) > -1e-6:
                break
            rows = [one] if single[one] <= double.flat[two] else list(divmod(two, len(single)))
            for row in rows:
                self._change(row)
        return self

    def window(self) -> Choices:
        """Return these marks and those others, one or two rows away, that lie in the window."""
        pairs = np.triu_indices(len(self.marks), 1)
        worse, plain = (
            np.concatenate([[0.0], single, double[pairs]])
            for single, double in (self._changes(), self._changes(signed=False))
        )
        both = zip(pairs[0].tolist(), pairs[1].tolist(), strict=True)
        rows: list[tuple[int, ...]] = [(), *((k,) for k in range(len(self.marks))), *both]
        kept = np.flatnonzero(worse < WINDOW)
        kept = kept[np.argsort(worse[kept], kind="stable")][:MOST_CHOICES]
        marks = np.tile(self.marks, (len(kept), 1))
        found = plain[kept]
        for k, number in enumerate(kept.tolist()):
            marks[k, list(rows[number])] ^= True
            found[k] += self._signed(rows[number])
        weight = np.exp(-0.5 * (found - found.min()))
        return Choices(marks, weight / weight.sum())

    def _signed(self, rows: tuple[int, ...]) -> float:
        """Return the sum of the penalties of all that is marked after a change of rows."""
        other = _Linear(self.marks.copy(), self.inverse, self.pull)
        for row in rows:
            other._change(row)
        return float(other.penalties()[other.marks].sum())

    def penalties(self) -> Floats:
        """Return what the sign of its detour costs each row (n,), or would if it were marked."""
        own = np.diag(self.inverse)
        grown = np.where(self.marks, 1.0, 1 + DETOUR_STD_M**2 * own)
        return _penalty(own / grown, (self.pull - np.where(self.marks, 0.0, DETOUR_M) * own) / grown)

    def _signs(self) -> tuple[Floats, Floats]:
        """Return what a change of each mark adds to the variance of its row, and to its mean."""
        sign = np.where(self.marks, -1.0, 1.0)
        return sign * DETOUR_STD_M**2, sign * DETOUR_M

    def _changes(self, *, signed: bool = True) -> tuple[Floats, Floats]:
        """Return what changes of one row (n,) and of two (n, n) add to -2 log likelihood; infinity on the diagonal.

        With the penalties of these rows, not of what they do to others', if `signed`.
        """
        variance, mean = self._signs()
        own = np.diag(self.inverse)
        first, grown = _added(own, self.pull, variance, mean)
        # After the change of row i: what row j has then, by the formula of Sherman and Morrison.
        shift = (variance * (self.pull - mean * own) / grown)[:, None]
        then_own = own - (variance / grown)[:, None] * self.inverse**2
        then_pull = self.pull - mean[:, None] * self.inverse - shift * self.inverse
        second, then_grown = _added(then_own, then_pull, variance, mean)
        if signed:
            sign, offset = np.where(self.marks, -1.0, 1.0), np.where(self.marks, 0.0, DETOUR_M)
            first = first + sign * self.penalties()
            marked = np.where(self.marks, 1.0, then_grown)
            second = second + sign * _penalty(then_own / marked, (then_pull - offset * then_own) / marked)
        count, rows = int(self.marks.sum()), len(self.marks)
        more = np.where(self.marks, -1, 1)
        prior = {k: unlikely(count + k, rows) for k in range(-2, 3) if 0 <= count + k <= rows}
        here = prior[0]
        single = first + np.array([prior.get(k, math.inf) - here for k in more.tolist()])
        both = more[:, None] + more
        pairs = np.array([[prior.get(k, math.inf) - here] for k in range(-2, 3)])[:, 0][both + 2]
        double = first[:, None] + second + pairs
        np.fill_diagonal(double, math.inf)
        return single, double

    def _change(self, row: int) -> None:
        variance, mean = (float(values[row]) for values in self._signs())
        column = self.inverse[:, row].copy()
        own = float(column[row])
        grown = 1 + variance * own
        pull = self.pull - mean * column
        self.pull = pull - column * variance * float(pull[row]) / grown
        self.inverse = self.inverse - np.outer(column, column) * variance / grown
        self.marks[row] ^= True


def _penalty(own: Floats, pull: Floats) -> Floats:
    """Return `too_short` of marked rows from the diagonal of their inverse covariance and that times deviations."""
    return too_short(DETOUR_M + DETOUR_STD_M**2 * pull, DETOUR_STD_M**2 - DETOUR_STD_M**4 * own)


def _added(own: Floats, pull: Floats, variance: Floats, mean: Floats) -> tuple[Floats, Floats]:
    """Return what a change of variance and mean of rows adds to -2 log likelihood, and by what determinants grow."""
    grown = np.maximum(1 + variance * own, 1e-12)
    away = pull - mean * own
    return np.log(grown) - 2 * mean * pull + mean**2 * own - variance * away**2 / grown, grown
