"""Calibrations: the model, its file, other formats, corrections, comparison."""
