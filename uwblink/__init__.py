"""The language of DWM1000 ranging boards: device time, wire messages, formulas, recordings.

>>> import uwblink
>>> x = uwblink.Exchanges.from_arrays([1], [2], tx1=[0], rx1=[5], tx2=[1005], rx2=[3000])
>>> uwblink.raw_range(x).round(3).tolist()
[4.69]
"""

from uwblink.lazy import homes_in, offer

__version__ = "0.3.0"

_homes = homes_in(__file__)
__all__ = list(_homes)
__getattr__, __dir__ = offer(__name__, _homes)
