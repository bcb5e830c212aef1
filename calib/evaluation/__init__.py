"""How good a calibration is: statistics, localization."""
