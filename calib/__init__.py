"""Fits, applies and evaluates calibrations of ultra-wideband ranges.

>>> import calib
>>> calib.__all__[:5]
['BadInputError', 'CalibError', 'Calibration', 'CorrectedRanges', 'FitResult']
"""

from uwblink.lazy import homes_in, offer

_homes = homes_in(__file__)
__all__ = list(_homes)
__getattr__, __dir__ = offer(__name__, _homes)
