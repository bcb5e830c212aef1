"""Ranges with true distances, from recordings, simulations, arrays and data frames."""

from calib.data.sources import load_each

__all__ = ["load_each"]
