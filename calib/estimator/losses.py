"""Robust losses: weights of residuals over the scale of the loss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.errors import BadInputError
from uwblink.arrays import Floats
from uwblink.errors import ArgumentError, raising
from uwblink.plugins import Registry

Weights = Callable[[Floats], tuple[Floats, Floats]]
"""Maps residuals over scale u (n,) to the weights rho'(u)/u of reweighted least squares and to the slope of the score
rho''(u), both (n,); a weight is 1 at u = 0."""


@dataclass(frozen=True, slots=True)
class RobustLoss:
    """A loss by its name; an entry point of the group `uwbcal.losses` names one, or a list of them."""

    name: str
    weights: Weights


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


MIXTURE: Final = "mixture"
"""The name of the likelihood of `calib.range_errors`, which starts from a Cauchy fit."""

TRIED_AT: Final = np.array([-7.3, -2.1, -0.83, -0.37, 0.37, 0.83, 2.1, 7.3])
"""Residuals over scale at which a new loss must agree with its own slope; no common loss has a kink at one."""


def register_loss(name: str, weights: Weights, *, replace: bool = False) -> None:
    """Add a robust loss, which `fit`, `run_campaign`, `add_tag` and the option `--loss` then accept by its name.

    `weights` maps residuals over scale u (n,), without a unit, to two arrays (n,): the weight rho'(u)/u, 1 at u = 0,
    and the slope rho''(u) of u times the weight, from which the intervals follow. `replace` replaces a registered loss
    of the same name. Raises `BadInputError` for a name that is taken, and for weights and slopes that contradict each
    other. For example the loss of Geman and McClure:

    >>> import calib
    >>> def geman_mcclure(u):
    ...     weight = 1 / (1 + u**2) ** 2
    ...     return weight, weight * (1 - 4 * u**2 / (1 + u**2))
    >>> calib.register_loss("geman-mcclure", geman_mcclure)

    And out again:

    >>> from calib.estimator.losses import LOSSES
    >>> LOSSES.remove("geman-mcclure")
    """
    try:
        LOSSES.register(RobustLoss(name, weights), replace=replace)
    except ArgumentError as error:
        raise BadInputError(str(error)) from error


def known_losses() -> list[str]:
    """Return the names that `fit` takes as its loss."""
    return [*LOSSES, MIXTURE]


def check_robust_loss(loss: RobustLoss) -> None:
    """Raise `ArgumentError` if a name is taken, or if weights and slopes contradict each other."""
    if not isinstance(loss, RobustLoss):
        raise ArgumentError(f"loss: found {type(loss).__name__}, expected a RobustLoss")
    if loss.name == MIXTURE:
        raise ArgumentError(f"loss {MIXTURE!r}: this name is reserved; choose another one")
    step = 1e-5
    u = np.concatenate([TRIED_AT - step, TRIED_AT, TRIED_AT + step, np.zeros(1)])
    what = f"loss {loss.name!r}: must return two arrays, weight and slope, as long as its argument"
    with raising(ArgumentError, what, TypeError, ValueError):
        weight, slope = (np.asarray(part, dtype=np.float64) for part in loss.weights(u))
    if weight.shape != u.shape or slope.shape != u.shape or not np.isfinite([weight, slope]).all():
        raise ArgumentError(f"loss {loss.name!r}: weight and slope must be finite, one for each residual")
    count = len(TRIED_AT)
    score = u * weight
    numeric = (score[2 * count : 3 * count] - score[:count]) / (2 * step)
    wrong = np.flatnonzero(np.abs(numeric - slope[count : 2 * count]) > 1e-4)
    if len(wrong):
        raise ArgumentError(
            f"loss {loss.name!r}: the slope at u = {TRIED_AT[wrong[0]]:g} is not that of u times the weight"
        )
    if abs(weight[-1] - 1) > 1e-9:
        raise ArgumentError(f"loss {loss.name!r}: the weight at u = 0 is {weight[-1]:g}, expected 1")


LOSSES: Final[Registry[RobustLoss]] = Registry(
    "loss",
    "uwbcal.losses",
    (
        RobustLoss("cauchy", _cauchy),
        RobustLoss("huber", _huber),
        RobustLoss("soft_l1", _soft_l1),
        RobustLoss("l2", _l2),
    ),
    check_robust_loss,
)
"""Losses by name: the project's, those of `register_loss`, and those of installed distributions."""


def check_loss(name: str | None) -> None:
    """Raise `BadInputError` for an unknown loss."""
    if name not in (None, MIXTURE) and name not in LOSSES:
        raise BadInputError(f"found {name!r}, allowed: {', '.join(known_losses())}", parameter="loss")
