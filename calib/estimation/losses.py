"""Robust losses: how much a residual counts for, by its size over the scale of the loss."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from calib.errors import BadInputError
from uwblink.arrays import Floats

Loss = Callable[[Floats], tuple[Floats, Floats]]
"""Maps residuals over scale u (n,) to the weights rho'(u)/u of reweighted least squares and to the slope of the score
rho''(u), both (n,); a weight is 1 at u = 0."""


def _cauchy(u: Floats) -> tuple[Floats, Floats]:
    weight = 1 / (1 + u**2)
    return weight, (1 - u**2) * weight**2


def _soft_l1(u: Floats) -> tuple[Floats, Floats]:
    weight = 1 / np.sqrt(1 + u**2)
    return weight, weight**3


def _huber(u: Floats) -> tuple[Floats, Floats]:
    size = np.maximum(np.abs(u), 1.0)
    return 1 / size, (size == 1.0).astype(np.float64)


def _l2(u: Floats) -> tuple[Floats, Floats]:
    return np.ones_like(u), np.ones_like(u)


LOSSES: Final[dict[str, Loss]] = {
    "cauchy": _cauchy,
    "huber": _huber,
    "soft_l1": _soft_l1,
    "l2": _l2,
}

MIXTURE: Final = "mixture"
"""The loss that is no loss of residuals: the likelihood of `calib.estimation.mixture_fit`, begun from a Cauchy fit."""

TRIED_AT: Final = np.array([-7.3, -2.1, -0.83, -0.37, 0.37, 0.83, 2.1, 7.3])
"""Residuals over scale at which a new loss must agree with its own slope; no common loss has a kink at one."""


def register_loss(name: str, loss: Loss) -> None:
    """Add a robust loss, which `fit`, `add_tag` and the command's `--loss` then know by its name.

    `loss` maps residuals over scale u (n,), without a unit, to two arrays (n,): the weight rho'(u)/u, 1 at u = 0, and
    the slope rho''(u) of u times the weight, from which the intervals follow. Raises `BadInputError` for a name that is
    taken, and for a function whose weight and slope contradict each other. Geman and McClure's, as an example:

    >>> import calib
    >>> def geman_mcclure(u):
    ...     weight = 1 / (1 + u**2) ** 2
    ...     return weight, weight * (1 - 4 * u**2 / (1 + u**2))
    >>> calib.register_loss("geman-mcclure", geman_mcclure)
    """
    if name in known_losses():
        raise BadInputError(f"a loss {name!r} is there already; choose another name", parameter="name")
    _check(name, loss)
    LOSSES[name] = loss


def known_losses() -> list[str]:
    """Return the names that `fit` takes as its loss."""
    return [*LOSSES, MIXTURE]


def _check(name: str, loss: Loss) -> None:
    """Raise `BadInputError` where weight and slope are not those of one loss."""
    step = 1e-5
    u = np.concatenate([TRIED_AT - step, TRIED_AT, TRIED_AT + step, np.zeros(1)])
    try:
        weight, slope = (np.asarray(part, dtype=np.float64) for part in loss(u))
    except (TypeError, ValueError) as error:
        raise BadInputError(
            f"loss {name!r} must return two arrays, weight and slope, as long as its argument ({error})",
            parameter="loss",
        ) from error
    if weight.shape != u.shape or slope.shape != u.shape or not np.isfinite([weight, slope]).all():
        raise BadInputError(f"loss {name!r}: weight and slope must be finite, one for each residual", parameter="loss")
    count = len(TRIED_AT)
    score = u * weight
    numeric = (score[2 * count : 3 * count] - score[:count]) / (2 * step)
    wrong = np.flatnonzero(np.abs(numeric - slope[count : 2 * count]) > 1e-4)
    if len(wrong) or abs(weight[-1] - 1) > 1e-9:
        where = f"the slope at u = {TRIED_AT[wrong[0]]:g} is not that of u times the weight" if len(wrong) else ""
        raise BadInputError(f"loss {name!r}: {where or 'the weight at u = 0 is not 1'}", parameter="loss")
