"""Rao's score tests of a fit: whether one more unknown is significant. They need no second fit.

An alternative is an offset of some ranges in addition to the fitted unknowns. Its slope, minus the part that the fitted
unknowns would absorb, is summed over short blocks of time and compared with its own variance, persistence included.
Unknowns that are in the fit already, with an estimated variance, are tested as if they had been omitted.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import sparse, special

from calib.estimator.optimize import Optimum
from calib.estimator.range_rows import RangeRows
from calib.estimator.rows import Terms, sparse_rows
from calib.estimator.time_blocks import Persistence, TimeBlocks, persistence
from calib.findings import exceeds
from uwblink.arrays import Floats, Ints

REACHED = 1e-3
"""Share of an alternative's information that the fitted unknowns must leave for it to be tested: with less, its
standard error is more than thirty times the one from its own ranges alone."""

SAME = 0.95
"""Alternatives whose tests correlate by more than this cannot be distinguished: a fault of ten standard errors in one
appears as 9.5 in the other, a difference of 1.6 standard deviations."""


@dataclass(frozen=True, slots=True)
class Derivative:
    """A sparse matrix (n, k), a few rows at a time: rows have `values` (n, m) or (n, 1) at `columns` (n, m)."""

    columns: Ints
    values: Floats
    size: int

    @property
    def shape(self) -> tuple[int, int]:
        """Return the numbers of rows and columns."""
        return len(self.columns), self.size

    def __getitem__(self, rows: Ints) -> sparse.csr_matrix:
        """Return some rows."""
        columns = self.columns[rows]
        values = np.broadcast_to(self.values if len(self.values) == 1 else self.values[rows], columns.shape)
        return sparse_rows(columns, values, self.size)


@dataclass(frozen=True, kw_only=True)
class Family:
    """Alternatives of one kind: `derivative` (n, k) is the derivative of the residual of each given range by each
    offset.

    `names` (k,) are their owners. `spans` is the number of spans of time within which the persistence of errors is
    measured: two if an alternative does not end. `fitted` are the indices of the unknowns that are these offsets, if
    they are in the fit already. If offsets belong to `sessions`, the offsets of one tag or pair in all sessions are
    side by side.
    """

    kind: str
    names: Sequence[str]
    derivative: Derivative | sparse.csr_matrix
    spans: int = 2
    fitted: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    sessions: tuple[str, ...] = ("",)


@dataclass(frozen=True, kw_only=True)
class FoundOffset:
    """An alternative that the residuals indicate: its kind, its possible owners, the offset, and its effect on delays.

    `deviation` is the offset in standard errors, `p_value` the probability of such a deviation by chance in any of the
    tests. `effects_ns` (1 or 2 of (tags,)) are the changes of delays: an offset of one session is equivalent to the
    opposite offset of all others, which has the second effect; `sessions` are that session and the others.
    """

    kind: str
    names: tuple[str, ...]
    offset_m: float
    deviation: float
    p_value: float
    effects_ns: tuple[Floats, ...]
    sessions: tuple[str, str] = ("", "")
    fitted: bool = False

    @property
    def spread_ns2(self) -> Floats:
        """Return the covariance (tags, tags) of delays if it is unknown which side of a difference is wrong.

        If offsets are fitted, delays lie halfway between both sides, and intervals already include their variance.
        """
        if self.fitted:
            apart = self.effects_ns[0] - self.effects_ns[-1]
            return np.asarray(np.outer(apart, apart) / 4)
        return np.asarray(np.mean([np.outer(effect, effect) for effect in self.effects_ns], axis=0))

    @property
    def largest_ns(self) -> float:
        """Return the largest change of a delay."""
        return float(np.max(np.abs(self.effects_ns), initial=0.0))


@dataclass(frozen=True, kw_only=True)
class Tested:
    """A family and its efficient slopes: sums `total` (k,), their `covariance` (k, k) and `information` (k, k).

    `pulled` (k,) is the contribution of the priors of fitted unknowns, such as random offsets, to the sums. `effects`
    (tags, k) are in ns/m, `whole` is the largest information of an alternative without other fitted unknowns.
    """

    family: Family
    total: Floats
    covariance: Floats
    information: Floats
    effects: Floats
    pulled: Floats
    whole: float
    lasting: Persistence
    blocks: int

    def combined(self, step: Floats) -> Tested:
        """Return the slopes of other offsets, which are combinations of these: the rows of `step` (m, k)."""
        return replace(
            self,
            total=step @ self.total,
            covariance=step @ self.covariance @ step.T,
            information=step @ self.information @ step.T,
            effects=self.effects @ step.T,
            pulled=step @ self.pulled,
        )

    def with_fitted(self, fitted: Sequence[int]) -> Tested:
        """Return the slopes if some offsets are fitted, too: the others keep the part that these do not explain."""
        which, step = np.array(fitted, dtype=np.int64), np.eye(len(self.total))
        own = self.information[np.ix_(which, which)]
        step[:, which] -= self.information[:, which] @ np.linalg.pinv(own, rcond=1e-9, hermitian=True)
        return self.combined(step)

    def joint_p_value(self, slope: Floats) -> float:
        """Return the p-value of slopes (k,) whose mean is zero if there are no offsets (Hotelling)."""
        solved, _, rank, _ = np.linalg.lstsq(self.covariance, slope, rcond=1e-12)
        count = max(int(rank), 1)
        freedom = max(min(self.lasting.freedom, self.blocks) - count, 1.0)
        return float(special.fdtrc(count, freedom, float(slope @ solved) / count))


class Slopes:
    """The slopes of a fit's ranges by the residual and by all unknowns, as the sums and products that tests need.

    `own` (blocks, p) are the slopes by unknowns of `count` rows, summed by block of time; if a search has rows of
    several kinds, of all rows (`Fitted.slopes`). `score` (n,) are the slopes by residuals, `information` (n,) the
    information of residuals, in the order of the rows. Slopes by unknowns are evaluated anew for tests: those of
    millions of ranges take gigabytes.
    """

    def __init__(self, rows: RangeRows, optimum: Optimum, blocks: TimeBlocks) -> None:
        """Evaluate rows at their optimum."""
        self.rows, self.optimum, self.blocks = rows, optimum, blocks
        self.order, size = rows.order, optimum.layout.size
        self.score, self.information = np.empty(len(rows)), np.zeros(len(rows))
        self.own = np.zeros((blocks.count, size))
        for which, terms in self._pieces():
            slopes = terms.as_matrix(terms.slopes, terms.score, size)
            self.own += (blocks.summing(self.order[which]) @ slopes).toarray()
            self.score[which] = terms.score
            for part in terms.squares:
                self.information[which] += part.residual * part.weight * part.residual
        self.count = len(rows)

    def _pieces(self) -> Iterator[tuple[slice, Terms]]:
        """Yield the indices of some rows, and their terms."""
        at = 0
        for terms in self.rows.terms(self.optimum.x):
            which = slice(at, at + terms.slopes.shape[1])
            yield which, terms
            at = which.stop

    def link(self, derivative: Derivative | sparse.csr_matrix) -> Floats:
        """Return the information (k, p) between offsets, as derivatives (n, k) of given ranges, and all unknowns."""
        return self._sums([derivative])[0][3]

    def test(self, family: Family) -> Tested:
        """Return a family's efficient slopes."""
        return self.tests([family])[0]

    def tests(self, families: Sequence[Family], more: Floats | None = None) -> list[Tested]:
        """Return the efficient slopes of families, whose sums are computed in one pass over the ranges.

        With derivatives of the ranges by one offset `more` (n,), this offset is the last of each family.
        """
        sums = self._sums([family.derivative for family in families], more)
        return [self._tested(family, *own) for family, own in zip(families, sums, strict=True)]

    def _sums(
        self, derivatives: Sequence[Derivative | sparse.csr_matrix], more: Floats | None = None
    ) -> list[list[Floats]]:
        """Return sums over all ranges for offsets with derivatives (n, k) of given ranges, and for one `more` (n,).

        By block of time: sums of slopes (blocks, k) and of the information of residuals (blocks, k). Of all: the
        information between offsets (k, k), and between offsets and unknowns (k, p).
        """
        (blocks, size), counts = self.own.shape, [each.shape[1] + (more is not None) for each in derivatives]
        sums = [[np.zeros(shape) for shape in ((blocks, k), (blocks, k), (k, k), (k, size))] for k in counts]
        for which, terms in self._pieces():
            rows = self.order[which]
            in_block, weights = self.blocks.summing(rows), sparse.diags(self.information[which])
            shared = [
                terms.as_matrix(pull * part.entries, pull * part.residual, size)
                for part in terms.squares
                for pull in [part.residual * part.weight]
            ]
            last = [] if more is None else [sparse.csr_matrix(more[rows, None])]
            for own, derivative in zip(sums, derivatives, strict=True):
                kept = sparse.csr_matrix(sparse.hstack([derivative[rows], *last]))
                own[0] += (in_block @ sparse.diags(self.score[which]) @ kept).toarray()
                own[1] += (in_block @ weights @ kept.power(2)).toarray()
                own[2] += (kept.T @ weights @ kept).toarray()
                for matrix in shared:
                    own[3] += (kept.T @ matrix).toarray()
        return sums

    def _tested(self, family: Family, plain: Floats, known: Floats, square: Floats, link: Floats) -> Tested:
        absorbed = self._absorbed(link, family.fitted)
        efficient, information = plain - self.own @ absorbed.T, square - absorbed @ link.T
        whole = max(float(np.diag(square)[: family.derivative.shape[1]].max()), 1e-300)
        total = efficient.sum(axis=0)
        if len(family.fitted):
            # The quadratic approximation of the likelihood gives the slopes without these unknowns.
            total = total + information[:, : len(family.fitted)] @ self.optimum.x[family.fitted]
        # Each block has the share of an offset that its information has: this is no scatter between blocks.
        whose = known.sum(axis=0)
        share = np.where(whose > 0, efficient.sum(axis=0) / np.where(whose > 0, whose, 1.0), 0.0)
        scatter = efficient - known * share
        independent = int(np.linalg.matrix_rank(information, tol=REACHED * whole, hermitian=True))
        lasting = persistence(scatter, self.blocks, independent, family.spans)
        return Tested(
            family=family,
            total=total,
            covariance=lasting.factor * (scatter.T @ scatter),
            information=information,
            effects=-absorbed.T[self.optimum.layout.where["delay"]],
            pulled=-absorbed @ self.optimum.priors.pull(self.optimum.x),
            whole=whole,
            lasting=lasting,
            blocks=len(scatter),
        )

    def _absorbed(self, link: Floats, fitted: Ints) -> Floats:
        """Return the parts of offsets that the unknowns absorb (k, p), without unknowns that are `fitted` offsets."""
        inverse = self.optimum.covariance
        absorbed = np.asarray(inverse @ link.T)
        if len(fitted):
            # Blockwise inversion: the inverse after rows and columns are removed from the matrix itself.
            columns = inverse[:, fitted]
            absorbed = absorbed - columns @ np.linalg.solve(columns[fitted], absorbed[fitted])
            absorbed[fitted] = 0.0
        return absorbed.T


def search(tested: Sequence[Tested], rate: float) -> list[FoundOffset]:
    """Return the significant alternatives of all families, the most significant first; a share `rate` of sound fits has
    any.

    Families have equal shares of the rate (Bonferroni's correction with weights), so an error that all ranges share is
    found in spite of many tags and spans of time.
    """
    found = [finding for one in tested for finding in findings(one, len(tested) * len(one.family.names), rate)]
    return sorted(found, key=lambda finding: finding.p_value)


def findings(tested: Tested, several: int, rate: float, tolerance_m: float = 0.0) -> Iterator[FoundOffset]:
    """Yield the significant alternatives of a family, one after the other, each with the previous ones fitted.

    Offsets up to the tolerance are no finding.
    """
    family, freedom = tested.family, max(tested.lasting.freedom, 3.0)
    # At most three alternatives are found one after the other: faults are few.
    for _ in range(3):
        total, covariance, information = tested.total, tested.covariance, tested.information
        std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
        known = np.diag(information) > REACHED * tested.whole
        beyond = np.maximum(np.abs(total) - tolerance_m * np.diag(information), 0.0)
        deviation = np.where(known, np.copysign(beyond, total) / std, 0.0)
        top = int(np.argmax(np.abs(deviation)))
        p_value = exceeds(float(deviation[top]), 1.0, freedom, tried=several)
        if p_value > rate:
            return
        # Residuals are fitted minus true: the offset of ranges has the opposite sign.
        offset = float(total[top] / information[top, top])
        alike = np.abs(covariance[top] / (std[top] * std)) > SAME
        close = alike & known & (np.abs(deviation) > SAME * abs(deviation[top]))
        effects, sessions = [tested.effects[:, top] * offset], ("", "")
        count = len(family.sessions)
        if count > 1:
            first = top - top % count
            others = [k for k in range(first, first + count) if k != top]
            rest = family.sessions[1 - top % count] if count == 2 else "the other recordings"
            effects.append(-tested.effects[:, others].sum(axis=1) * offset)
            sessions = (family.sessions[top % count], rest)
        yield FoundOffset(
            kind=family.kind,
            names=tuple(dict.fromkeys(family.names[k] for k in np.flatnonzero(close).tolist())),
            offset_m=-offset,
            deviation=float(deviation[top]),
            p_value=p_value,
            effects_ns=tuple(effects),
            sessions=sessions,
            fitted=len(family.fitted) > 0,
        )
        tested = tested.with_fitted([top])


def widening(tested: Tested) -> Floats:
    """Return the covariance (tags, tags) of delays by offsets whose scatter exceeds the uncertainty of their slopes.

    They are taken as random with one variance, estimated by the method of moments (DerSimonian and Laird 1986): the
    weighted square of all slopes exceeds its expectation by the variance times a trace.
    """
    values, vectors = np.linalg.eigh(tested.information)
    base = vectors[:, values > REACHED * tested.whole]
    freedom = base.shape[1]
    if not freedom:
        return np.zeros((len(tested.effects),) * 2)
    inverse = np.linalg.pinv(base.T @ tested.covariance @ base, rcond=1e-9, hermitian=True)
    # The inverse of a covariance of few blocks is too large on average (of Wishart's distribution).
    inverse *= max(1 - (freedom + 1) / tested.blocks, 0.1)
    slope, reach = base.T @ tested.total, base.T @ tested.information
    trace = float(np.trace(reach.T @ inverse @ reach))
    variance = max(float(slope @ inverse @ slope) - freedom, 0.0) / max(trace, 1e-300)
    return np.asarray(variance * tested.effects @ tested.effects.T)
