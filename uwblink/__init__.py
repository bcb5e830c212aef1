"""The language of DWM1000 ranging boards: device time, wire messages, formulas, recordings."""

__version__ = "0.1.0"
