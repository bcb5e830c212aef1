"""Turns other people's files into recordings."""
