"""A discrete-event simulator of tags that range with ultra-wideband radios.

>>> import uwbsim
>>> uwbsim.__all__[-3:]
['simulate', 'through_wire', 'twin']
"""

from typing import TYPE_CHECKING

from uwblink.lazy import offer

if TYPE_CHECKING:
    from uwbsim import pages as pages
    from uwbsim import protocols as protocols
    from uwbsim import scenario as scenario
    from uwbsim import twins as twins
    from uwbsim.boards.server import Server, load_faults
    from uwbsim.boards.virtual_board import VirtualPorts
    from uwbsim.errors import ParameterError, ScenarioError, UwbsimError
    from uwbsim.pages.documents import show
    from uwbsim.protocols.comparison import ProtocolComparison, compare, optimum
    from uwbsim.protocols.prediction import FleetFigures, Prediction, State, predict_fleet, predict_state
    from uwbsim.scenario.loading import load, shipped_scenarios
    from uwbsim.scenario.model import Scenario
    from uwbsim.simulation.run import Simulated, preview, simulate, through_wire
    from uwbsim.sweep.design import load_design
    from uwbsim.sweep.runner import run_sweep
    from uwbsim.twins.fitting import Twin, twin
    from uwbsim.world.channel import register_channel_effect

__all__ = [
    "FleetFigures",
    "ParameterError",
    "Prediction",
    "ProtocolComparison",
    "Scenario",
    "ScenarioError",
    "Server",
    "Simulated",
    "State",
    "Twin",
    "UwbsimError",
    "VirtualPorts",
    "compare",
    "load",
    "load_design",
    "load_faults",
    "optimum",
    "predict_fleet",
    "predict_state",
    "preview",
    "register_channel_effect",
    "run_sweep",
    "shipped_scenarios",
    "show",
    "simulate",
    "through_wire",
    "twin",
]

_homes = {
    "FleetFigures": "uwbsim.protocols.prediction",
    "ParameterError": "uwbsim.errors",
    "Prediction": "uwbsim.protocols.prediction",
    "ProtocolComparison": "uwbsim.protocols.comparison",
    "Scenario": "uwbsim.scenario.model",
    "ScenarioError": "uwbsim.errors",
    "Server": "uwbsim.boards.server",
    "Simulated": "uwbsim.simulation.run",
    "State": "uwbsim.protocols.prediction",
    "Twin": "uwbsim.twins.fitting",
    "UwbsimError": "uwbsim.errors",
    "VirtualPorts": "uwbsim.boards.virtual_board",
    "compare": "uwbsim.protocols.comparison",
    "load": "uwbsim.scenario.loading",
    "load_design": "uwbsim.sweep.design",
    "load_faults": "uwbsim.boards.server",
    "optimum": "uwbsim.protocols.comparison",
    "predict_fleet": "uwbsim.protocols.prediction",
    "predict_state": "uwbsim.protocols.prediction",
    "preview": "uwbsim.simulation.run",
    "register_channel_effect": "uwbsim.world.channel",
    "run_sweep": "uwbsim.sweep.runner",
    "shipped_scenarios": "uwbsim.scenario.loading",
    "show": "uwbsim.pages.documents",
    "simulate": "uwbsim.simulation.run",
    "through_wire": "uwbsim.simulation.run",
    "twin": "uwbsim.twins.fitting",
}

if not TYPE_CHECKING:
    __getattr__, __dir__ = offer(__name__, _homes)
