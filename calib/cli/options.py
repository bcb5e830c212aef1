"""What the words, numbers and files of the command line mean; mistakes are found before anything is written."""

from __future__ import annotations

import math
from collections.abc import Iterable
from functools import partial
from pathlib import Path

from calib.errors import BadInputError
from calib.estimation import FitSettings
from uwblink.toml import TomlReader


def fit_options(
    loss: str | None,
    scale: str,
    lift: str,
    fix: Iterable[str] | None,
    group: Path | None,
    *,
    sequential: bool,
    minimum_norm: bool,
    reference_power_dbm: float | None = None,
    delays_only: bool = False,
    delays_from: Path | None = None,
    constants: str = "tag",
) -> FitSettings:
    """Return what the options of a fit mean; raises `BadInputError` for what cannot be read."""
    return {
        "loss": loss,
        "scale_ns": scale_ns(scale),
        "lift": lift,
        "fixed_ns": fixed_ns(fix or ()),
        "groups": groups_of_tags(group) if group else {},
        "sequential": sequential,
        "minimum_norm": minimum_norm,
        "reference_power_dbm": reference_power_dbm,
        "delays_only": delays_only,
        "delays_from": delays_from,
        "constants": constants,
    }


def groups_of_tags(path: Path) -> dict[str, tuple[int, ...]]:
    """Read a design file: a table `groups` that maps names to lists of tags; raises `BadInputError`."""
    table = TomlReader(path, partial(BadInputError, parameter="groups")).table
    groups = table.get("groups")
    if not isinstance(groups, dict) or not groups or set(table) != {"groups"}:
        raise BadInputError(f"{path}: expected one table [groups], as in: monopole = [1, 2]", parameter="groups")
    for name, tags in groups.items():
        if not isinstance(tags, list):
            raise BadInputError(f"{path}: {name}: expected a list of tag ids, as in [1, 2]", parameter="groups")
    return {name: tuple(tags) for name, tags in groups.items()}


def scale_ns(text: str) -> float | None:
    """Return the scale in nanoseconds, None for auto."""
    if text == "auto":
        return None
    try:
        return float(text)
    except ValueError:
        raise BadInputError(f"found {text!r}, expected auto or a positive number of ns", parameter="scale_ns") from None


def fixed_ns(texts: Iterable[str]) -> dict[int, float]:
    """Return pinned delays by tag from texts TAG=NS."""
    fixed: dict[int, float] = {}
    for text in texts:
        tag, equals, value = text.partition("=")
        try:
            delay = float(value)
        except ValueError:
            delay = math.nan
        if not (equals and tag.strip().isdecimal() and math.isfinite(delay)):
            raise BadInputError(f"found {text!r}, expected TAG=NS, as in 1=-0.36", parameter="fixed_ns")
        if int(tag) in fixed:
            raise BadInputError(f"tag {int(tag)} is pinned twice", parameter="fixed_ns")
        fixed[int(tag)] = delay
    return fixed
