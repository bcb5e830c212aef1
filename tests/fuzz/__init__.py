"""Fuzzing of the commands by mutations of every kind of file and of options."""
