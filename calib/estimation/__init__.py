"""From ranges to calibrations: the fit and what it doubts."""
