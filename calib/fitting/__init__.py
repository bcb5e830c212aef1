"""Fits of known distances: `calib.fit`, a new tag, delays from what is overheard."""

from calib.estimator.losses import known_losses

__all__ = ["known_losses"]
