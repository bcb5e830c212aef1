"""Ranging protocols: their rows, formulas, the table of them, and what a row must be."""
