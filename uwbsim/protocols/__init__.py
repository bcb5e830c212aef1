"""The protocol workbench: Monte Carlo, prediction, comparison."""

from uwbsim.protocols.conditions import chosen

__all__ = ["chosen"]
