"""What the parameters of a fit may be; mistakes are found before anything is computed."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Mapping
from typing import TypedDict

import numpy as np

from calib.calibration.model import Calibration
from calib.calibration.power_curves import LIFTS
from calib.errors import BadInputError
from calib.estimation.losses import LOSSES, MIXTURE, known_losses
from calib.estimation.unknowns import CONSTANTS

HIGHEST_TAG = 65_535


class FitSettings(TypedDict, total=False):
    """The keyword arguments of `calib.fit`."""

    loss: str | None
    scale_ns: float | None
    lift: str
    alpha_dbm: float
    fixed_ns: Mapping[int, float] | None
    groups: Mapping[str, tuple[int, ...]] | None
    sequential: bool
    minimum_norm: bool
    reference_power_dbm: float | None
    delays_only: bool
    delays_from: Calibration | str | os.PathLike[str] | None
    constants: str


def check_fit(  # noqa: PLR0913 - one a setting of a fit
    *,
    loss: str,
    scale_ns: float | None,
    lift: str,
    alpha_dbm: float,
    fixed_ns: Mapping[int, float],
    groups: Mapping[str, Iterable[int]],
    sequential: bool,
    reference_power_dbm: float | None = None,
    constants: str = "tag",
) -> None:
    """Raise `BadInputError` that names the parameter of `calib.fit` that cannot be used."""
    check_loss(loss)
    check_choice("lift", lift, LIFTS)
    check_choice("constants", constants, CONSTANTS)
    if scale_ns is not None and not (_is_finite(scale_ns) and scale_ns > 0):
        raise BadInputError(f"found {scale_ns!r}, expected a positive number of ns", parameter="scale_ns")
    if not _is_finite(alpha_dbm):
        raise BadInputError(f"found {alpha_dbm!r}, expected a power in dBm", parameter="alpha_dbm")
    if reference_power_dbm is not None and not _is_finite(reference_power_dbm):
        raise BadInputError(f"found {reference_power_dbm!r}, expected a power in dBm", parameter="reference_power_dbm")
    if sequential and loss == MIXTURE:
        raise BadInputError("goes with a loss, not with the mixture; leave one of the two away", parameter="sequential")
    for tag, delay in fixed_ns.items():
        if not (_is_tag(tag) and _is_finite(delay)):
            raise BadInputError(
                f"found {tag!r}: {delay!r}, expected a tag id and its delay in ns", parameter="fixed_ns"
            )
    _check_groups(groups)


def check_loss(loss: str) -> None:
    """Raise `BadInputError` for a loss that nobody knows."""
    if loss != MIXTURE and loss not in LOSSES:
        check_choice("loss", loss, known_losses())


def check_choice(parameter: str, value: str, allowed: Iterable[str]) -> None:
    """Raise `BadInputError` that lists what is allowed."""
    if value not in allowed:
        raise BadInputError(f"found {value!r}, allowed: {', '.join(allowed)}", parameter=parameter)


def check_tag(tag: int) -> None:
    """Raise `BadInputError` for what cannot be the id of a tag."""
    if not _is_tag(tag):
        raise BadInputError(f"found {tag!r}, expected the id of a tag, 0 to {HIGHEST_TAG}", parameter="tag")


def _check_groups(groups: Mapping[str, Iterable[int]]) -> None:
    seen: dict[int, str] = {}
    for name, tags in groups.items():
        listed = list(tags) if isinstance(tags, Iterable) and not isinstance(tags, str) else []
        if not listed or not all(_is_tag(tag) for tag in listed):
            raise BadInputError(f"{name}: expected a list of tag ids, as in [1, 2]", parameter="groups")
        for tag in listed:
            if tag in seen:
                raise BadInputError(f"tag {tag} is in {seen[tag]!r} and in {name!r}", parameter="groups")
            seen[tag] = name


def _is_tag(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= int(value) <= HIGHEST_TAG


def _is_finite(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
