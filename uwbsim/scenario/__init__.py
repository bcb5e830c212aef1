"""Scenarios: their models, and the way from a file to them."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.scenario.shipped import copy_scenarios, listed, shipped_scenarios
    from uwbsim.scenario.tags import with_antenna_delays

__all__ = [
    "copy_scenarios",
    "listed",
    "shipped_scenarios",
    "with_antenna_delays",
]

_HOMES: Final = {
    "copy_scenarios": "uwbsim.scenario.shipped",
    "listed": "uwbsim.scenario.shipped",
    "shipped_scenarios": "uwbsim.scenario.shipped",
    "with_antenna_delays": "uwbsim.scenario.tags",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
