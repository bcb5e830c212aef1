"""Which unknowns an information matrix determines, and a description of the combinations that it leaves free.

An information matrix (J' W J of a fit, the inverse of a covariance) is singular along directions without information,
and nearly singular along directions with little information. Each unknown has a prior standard deviation (`scale`), in
whose units directions are judged: an antenna delay is known to a nanosecond without data, so an estimate with a larger
standard error is useless.
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
"""Largest standard deviation of a determined direction, relative to its prior one. The data then have four times the
information of the prior."""

ROUNDING: Final = 1e-12
"""Eigenvalues below this share of the largest one are rounding errors."""

TAKES_PART: Final = 0.02
"""Smallest component of a free direction, relative to its largest one, whose unknown is named."""


@dataclass(frozen=True, slots=True)
class InformationColumn:
    """One unknown, a column of an information matrix: its kind ("delay"), its owner `of` ("3"), and its prior `scale`.

    Columns with equal kind and owner, such as the three coordinates of a position, are named once.
    """

    kind: str
    of: str
    scale: float = 1.0

    def __str__(self) -> str:
        """Return kind and owner, such as "delay of 3"."""
        return f"{self.kind} of {self.of}" if self.of else self.kind


@dataclass(frozen=True, slots=True, kw_only=True)
class Verdict:
    """The unknowns that an information matrix determines.

    `std` (n,) is the standard deviation of each unknown, infinite if the data do not determine it. `covariance` (n, n)
    is NaN in the rows and columns of these. `free` describes the combinations of unknowns that the data leave free.
    """

    unknowns: tuple[InformationColumn, ...]
    std: Floats
    covariance: Floats
    free: tuple[str, ...]

    @property
    def determined(self) -> Bools:
        """Mask (n,) of the unknowns that the data determine."""
        return np.isfinite(self.std)

    def named(self, kind: str) -> tuple[str, ...]:
        """Return the owners of undetermined unknowns of a kind, each once and in order, such as tags for "delay"."""
        loose = zip(self.unknowns, self.determined.tolist(), strict=True)
        return tuple(dict.fromkeys(u.of for u, known in loose if u.kind == kind and not known))

    def __str__(self) -> str:
        """Return the free combinations, one per line."""
        return "\n".join(self.free) or "all unknowns are determined"


def judge(information: Floats, unknowns: Sequence[InformationColumn], *, loosest: float = LOOSEST) -> Verdict:
    """Return which of the `unknowns` (n,) a positive semi-definite information matrix (n, n) determines.

    Unknowns are divided by their scales. An unknown, or a direction of unit length, is determined if its standard
    deviation is at most `loosest`. Raises `BadInputError` if the matrix has another shape, is not finite, not symmetric
    or not positive semi-definite, and if `loosest` is not positive.

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
    # Rounding errors of a zero eigenvalue are at most this large. Such directions get the standard deviation of it.
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
    """Return the information (k, k) on the unknowns to `keep` (indices or a mask) if the others are estimated, too.

    It is the Schur complement; a pseudo-inverse leaves out directions of the others without information.
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
    # Rounding errors of the difference are relative to `given`, and may exceed it: remove eigenvalues below that.
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
    """Yield a sparse basis of the span of the columns of `free` (n, k).

    Each vector has one unknown in which all following vectors are zero; earlier unknowns are preferred.
    """
    left = free.T.copy()
    while len(left):
        size = np.linalg.norm(left, axis=0)
        column = int(np.argmax(size > 0.5 * size.max()))
        # Rotate the basis: the first vector gets all of this unknown, the others get none.
        turned = np.linalg.svd(left[:, [column]], full_matrices=True)[0].T @ left
        yield turned[0]
        left = turned[1:]


def _in_words(direction: Floats, unknowns: Sequence[InformationColumn]) -> str:
    """Return a free direction in words, such as "all delays together with all positions"."""
    named = np.abs(direction) > TAKES_PART * np.abs(direction).max()
    return " with ".join(
        _of_kind(kind, direction, named, unknowns)
        for kind in dict.fromkeys(u.kind for u, part in zip(unknowns, named, strict=True) if part)
    )


def _of_kind(kind: str, direction: Floats, named: Bools, unknowns: Sequence[InformationColumn]) -> str:
    """Return the unknowns of one kind in a direction, in words; "against" separates those with opposite signs."""
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
