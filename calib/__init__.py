"""Fits, applies and evaluates calibrations of ultra-wideband ranges."""
