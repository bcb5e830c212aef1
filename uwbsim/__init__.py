"""A discrete-event simulator of tags that range with ultra-wideband radios.

>>> import uwbsim
>>> uwbsim.__all__[-3:]
['register_channel_effect', 'run_sweep', 'simulate']
"""

from typing import TYPE_CHECKING, Final

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim.boards.server import Server
    from uwbsim.boards.virtual_port import VirtualPorts
    from uwbsim.errors import ParameterError, ScenarioError, UwbsimError
    from uwbsim.protocols.comparison import compare
    from uwbsim.protocols.reply_delay import optimum
    from uwbsim.protocols.single_state import State, predict_state
    from uwbsim.scenario.loading import load
    from uwbsim.scenario.model import Scenario
    from uwbsim.simulation.run import Simulated, simulate
    from uwbsim.sweep.design import load_design
    from uwbsim.sweep.runner import run_sweep
    from uwbsim.world.channel import register_channel_effect

__all__ = [
    "ParameterError",
    "Scenario",
    "ScenarioError",
    "Server",
    "Simulated",
    "State",
    "UwbsimError",
    "VirtualPorts",
    "compare",
    "load",
    "load_design",
    "optimum",
    "predict_state",
    "register_channel_effect",
    "run_sweep",
    "simulate",
]

_HOMES: Final = {
    "ParameterError": "uwbsim.errors",
    "Scenario": "uwbsim.scenario.model",
    "ScenarioError": "uwbsim.errors",
    "Server": "uwbsim.boards.server",
    "Simulated": "uwbsim.simulation.run",
    "State": "uwbsim.protocols.single_state",
    "UwbsimError": "uwbsim.errors",
    "VirtualPorts": "uwbsim.boards.virtual_port",
    "compare": "uwbsim.protocols.comparison",
    "load": "uwbsim.scenario.loading",
    "load_design": "uwbsim.sweep.design",
    "optimum": "uwbsim.protocols.reply_delay",
    "predict_state": "uwbsim.protocols.single_state",
    "register_channel_effect": "uwbsim.world.channel",
    "run_sweep": "uwbsim.sweep.runner",
    "simulate": "uwbsim.simulation.run",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _HOMES)
