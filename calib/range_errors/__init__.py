"""The error model of ranges, used by all fits, checks and filters."""
