"""The protocol workbench: Monte Carlo, prediction, comparison."""
