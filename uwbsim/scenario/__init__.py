"""Scenarios: their models, and the way from a file to them."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.scenario.devices import with_antenna_delays
    from uwbsim.scenario.loading import copy_scenarios, listed, shipped_scenarios

__all__ = [
    "copy_scenarios",
    "listed",
    "shipped_scenarios",
    "with_antenna_delays",
]

_HOMES: Final = {
    "copy_scenarios": "uwbsim.scenario.loading",
    "listed": "uwbsim.scenario.loading",
    "shipped_scenarios": "uwbsim.scenario.loading",
    "with_antenna_delays": "uwbsim.scenario.devices",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
