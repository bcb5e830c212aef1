"""Directions that an information matrix determines, and a description of those it does not.

An information matrix (the inverse of a covariance, J' W J of a fit) is singular along directions without information,
and nearly singular along directions with little. A direction is judged in units of prior knowledge (`scale` of each
unknown): an antenna delay is known to a nanosecond without any data, so an estimate with a larger standard error has no
value.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.errors import BadInputError
from uwblink.arrays import Bools, Floats

LOOSEST: Final = 0.5
"""Largest standard deviation of a determined direction, as a share of its prior one: the data then weigh four times as
much as the prior."""

ROUNDING: Final = 1e-12
"""Eigenvalues below this share of the largest one are rounding errors."""

TAKES_PART: Final = 0.02
"""An unknown is named if its part of a free direction exceeds this share of the largest part."""


@dataclass(frozen=True, slots=True)
class InformationColumn:
    """One column of an information matrix: what it is ("delay"), of what ("3"), and how far it is known without data.

    Several columns may be the same thing of the same (the three coordinates of a position), and are named once.
    """

    kind: str
    of: str
    scale: float = 1.0

    def __str__(self) -> str:
        """Return both words."""
        return f"{self.kind} of {self.of}" if self.of else self.kind


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """What an information matrix determines.

    `std` (n,) is infinite where the data do not determine an unknown, and `covariance` (n, n) is NaN in its row and
    column. `free` are the combinations of unknowns that the data leave free, in words.
    """

    unknowns: tuple[InformationColumn, ...]
    std: Floats
    covariance: Floats
    free: tuple[str, ...]

    @property
    def determined(self) -> Bools:
        """Which unknowns (n,) the data determine."""
        return np.isfinite(self.std)

    def named(self, kind: str) -> tuple[str, ...]:
        """Return of what a kind of unknown is not determined, each once and in order: tags whose delay is free."""
        loose = zip(self.unknowns, self.determined.tolist(), strict=True)
        return tuple(dict.fromkeys(u.of for u, known in loose if u.kind == kind and not known))

    def __str__(self) -> str:
        """Return what is free, a line each."""
        return "\n".join(self.free) or "all unknowns are determined"


def judge(information: Floats, unknowns: Sequence[InformationColumn], *, loosest: float = LOOSEST) -> Verdict:
    """Return what a positive semi-definite information matrix (n, n) says of its unknowns.

    A direction, or an unknown, counts as determined where its standard deviation is at most `loosest` times the scale
    (of a direction: of its parts together). Raises `BadInputError` for a matrix that is none.

    >>> import numpy as np
    >>> from calib.information import InformationColumn, judge
    >>> apart = np.array([[1.0, 1.0, 0.0], [1.0, 0.0, 1.0]])
    >>> verdict = judge(1e4 * apart.T @ apart, [InformationColumn("delay", tag) for tag in "123"])
    >>> print(verdict)
    delay of 1 against delays of 2 and 3
    """
    scale = _checked(information, unknowns, loosest)
    values, vectors = np.linalg.eigh(scale[:, None] * information * scale)
    largest = max(float(values[-1]), 0.0)
    if values[0] < -math.sqrt(ROUNDING) * largest:
        raise BadInputError(f"has the eigenvalue {values[0]:.3g}, expected none below 0", parameter="information")
    # Rounding lifts a free direction to this at most; below it there is nothing, and what is nothing is made as loose.
    nothing = values <= ROUNDING * len(values) * largest
    spread = vectors / np.sqrt(np.where(nothing, max(ROUNDING * largest, 1e-300), values))
    deviation = np.linalg.norm(spread, axis=1)
    loose = deviation > loosest
    free = nothing | (np.maximum(values, 0.0) < loosest**-2)
    return Verdict(
        unknowns=tuple(unknowns),
        std=np.where(loose, math.inf, deviation * scale),
        covariance=np.where(loose[:, None] | loose, np.nan, (spread @ spread.T) * scale[:, None] * scale),
        free=tuple(_in_words(found, unknowns) for found in _sparse(vectors[:, free])),
    )


def reduced(information: Floats, keep: Sequence[int] | Bools) -> Floats:
    """Return the information (k, k) on some of the unknowns (indices or a mask), whatever the others are.

    That is the Schur complement; what the others leave free stays free.
    """
    count = len(information)
    mask = np.zeros(count, dtype=bool)
    mask[np.asarray(keep)] = True
    kept, rest = np.flatnonzero(mask), np.flatnonzero(~mask)
    if not len(rest):
        return np.array(information[np.ix_(kept, kept)])
    size = np.sqrt(np.maximum(np.diag(information)[rest], 1e-300))
    values, vectors = np.linalg.eigh(information[np.ix_(rest, rest)] / size[:, None] / size)
    good = values > ROUNDING * len(rest) * max(float(values[-1]), 1e-300)
    root = (information[np.ix_(kept, rest)] / size) @ vectors[:, good] / np.sqrt(values[good])
    given = information[np.ix_(kept, kept)]
    found = given - root @ root.T
    # The difference has rounding errors of the size of what it was taken from, and may be all there is: none below 0.
    unit = np.sqrt(np.maximum(np.diag(given), 1e-300))
    values, vectors = np.linalg.eigh((found + found.T) / 2 / unit[:, None] / unit)
    values[values < ROUNDING * len(kept)] = 0.0
    return np.asarray((vectors * values) @ vectors.T * unit[:, None] * unit)


def _checked(information: Floats, unknowns: Sequence[InformationColumn], loosest: float) -> Floats:
    count, wrong = len(unknowns), ""
    if not count or np.shape(information) != (count, count):
        wrong = f"has the shape {np.shape(information)}, expected {count} rows and columns, one an unknown"
    elif not np.all(np.isfinite(information)):
        wrong = "contains a number that is not finite"
    elif np.abs(information - information.T).max() > 1e-6 * np.abs(information).max():
        wrong = "is not symmetric"
    if wrong:
        raise BadInputError(wrong, parameter="information")
    if not (math.isfinite(loosest) and loosest > 0):
        raise BadInputError(f"found {loosest}, expected a positive number", parameter="loosest")
    return np.array([unknown.scale for unknown in unknowns])


def _sparse(free: Floats) -> Iterator[Floats]:
    """Yield a basis of the span of `free` (n, k), each vector with one unknown of its own, the first ones preferred."""
    left = free.T.copy()
    while len(left):
        size = np.linalg.norm(left, axis=0)
        column = int(np.argmax(size > 0.5 * size.max()))
        # The vector of the span with the largest part in that unknown; the rest is turned to have none.
        turned = np.linalg.svd(left[:, [column]], full_matrices=True)[0].T @ left
        yield turned[0]
        left = turned[1:]


def _in_words(direction: Floats, unknowns: Sequence[InformationColumn]) -> str:
    """Return what moves together: "all delays together with all positions" and the like."""
    named = np.abs(direction) > TAKES_PART * np.abs(direction).max()
    return " with ".join(
        _of_kind(kind, direction, named, unknowns)
        for kind in dict.fromkeys(u.kind for u, part in zip(unknowns, named, strict=True) if part)
    )


def _of_kind(kind: str, direction: Floats, named: Bools, unknowns: Sequence[InformationColumn]) -> str:
    """Return the part of one kind: all, or which, and which grow as others shrink."""
    everyone = [k for k, unknown in enumerate(unknowns) if unknown.kind == kind]
    moving = [k for k in everyone if named[k]]
    names = list(dict.fromkeys(unknowns[k].of for k in moving))
    whole = len(names) == len({unknowns[k].of for k in everyone}) > 1
    if len(names) < len(moving):
        return f"all {kind}s" if whole else _listed(kind, names)
    up = [unknowns[k].of for k in moving if direction[k] * direction[moving[0]] > 0]
    down = [name for name in names if name not in up]
    if down:
        return f"{_listed(kind, up)} against {_listed(kind, down)}"
    return f"all {kind}s together" if whole else _listed(kind, names)


def _listed(kind: str, names: Sequence[str]) -> str:
    if names == [""]:
        return kind
    *most, last = names
    return f"{kind}s of {', '.join(most)} and {last}" if most else f"{kind} of {last}"
