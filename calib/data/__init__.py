"""From recordings, simulations, arrays and data frames to ranges with true distances."""

from calib.data.sources import load_each

__all__ = ["load_each"]
