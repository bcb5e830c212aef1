"""Calibration without true distances: boards that stand still, in several arrangements."""
