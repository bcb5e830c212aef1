"""Fuzzing: coverage-guided for the decoder, by mutations of every kind of file for the commands."""
