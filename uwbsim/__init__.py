"""A discrete-event simulator of tags that range with ultra-wideband radios."""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.boards.virtual_port import VirtualPorts
    from uwbsim.errors import ParameterError, ScenarioError, UwbsimError
    from uwbsim.scenario.loading import load
    from uwbsim.scenario.model import Scenario
    from uwbsim.simulation.run import Simulated, simulate
    from uwbsim.world.channel import register_channel_effect

__all__ = [
    "ParameterError",
    "Scenario",
    "ScenarioError",
    "Simulated",
    "UwbsimError",
    "VirtualPorts",
    "load",
    "register_channel_effect",
    "simulate",
]

_HOMES: Final = {
    "ParameterError": "uwbsim.errors",
    "Scenario": "uwbsim.scenario.model",
    "ScenarioError": "uwbsim.errors",
    "Simulated": "uwbsim.simulation.run",
    "UwbsimError": "uwbsim.errors",
    "VirtualPorts": "uwbsim.boards.virtual_port",
    "load": "uwbsim.scenario.loading",
    "register_channel_effect": "uwbsim.world.channel",
    "simulate": "uwbsim.simulation.run",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
