"""A discrete-event simulator of tags that range with ultra-wideband radios.

>>> import uwbsim
>>> uwbsim.__all__[-3:]
['simulate', 'through_wire', 'twin']
"""

from uwblink.lazy import homes_in, offer

_homes = homes_in(__file__)
__all__ = list(_homes)
__getattr__, __dir__ = offer(__name__, _homes)
