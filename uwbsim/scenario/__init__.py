"""Scenarios: their models, and the way from a file to them."""
