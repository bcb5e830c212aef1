"""What the package offers: the names, and the rooms, that are imported on first use (`uwblink.lazy`)."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:  # so that mypy follows other imports first
    from uwbsim import pages as pages
    from uwbsim import protocols as protocols
    from uwbsim import scenario as scenario
    from uwbsim import twins as twins
    from uwbsim.boards.server import Server as Server
    from uwbsim.boards.server import load_faults as load_faults
    from uwbsim.boards.virtual_board import VirtualPorts as VirtualPorts
    from uwbsim.errors import ParameterError as ParameterError
    from uwbsim.errors import ScenarioError as ScenarioError
    from uwbsim.errors import UwbsimError as UwbsimError
    from uwbsim.pages.documents import show as show
    from uwbsim.protocols.comparison import ProtocolComparison as ProtocolComparison
    from uwbsim.protocols.comparison import compare as compare
    from uwbsim.protocols.comparison import optimum as optimum
    from uwbsim.protocols.prediction import FleetFigures as FleetFigures
    from uwbsim.protocols.prediction import Prediction as Prediction
    from uwbsim.protocols.prediction import predict_fleet as predict_fleet
    from uwbsim.protocols.prediction import predict_state as predict_state
    from uwbsim.scenario.loading import load as load
    from uwbsim.scenario.loading import shipped_scenarios as shipped_scenarios
    from uwbsim.scenario.model import Scenario as Scenario
    from uwbsim.settings import State as State
    from uwbsim.simulation.run import Simulated as Simulated
    from uwbsim.simulation.run import preview as preview
    from uwbsim.simulation.run import simulate as simulate
    from uwbsim.simulation.run import through_wire as through_wire
    from uwbsim.sweep.design import load_design as load_design
    from uwbsim.sweep.runner import run_sweep as run_sweep
    from uwbsim.twins.fitting import Twin as Twin
    from uwbsim.twins.fitting import twin as twin
    from uwbsim.world.channel import register_channel_effect as register_channel_effect
