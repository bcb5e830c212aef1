"""What a surface gives back of a wave: Fresnel's coefficients, and what its roughness takes of them."""

from __future__ import annotations

from typing import Final

import numpy as np

from uwblink.arrays import Complexes, Floats
from uwbsim.scenario.model import WAVELENGTH_M

NEPER_DB: Final = 20 / np.log(10)
WAVENUMBER: Final = 2 * np.pi / WAVELENGTH_M

METAL: Final = 1 - 4.5e7j
"""Relative permittivity of a conductor of 10^7 S/m at 4 GHz (ITU-R P.2040-3, table 3)."""


def permittivity(loss_db_per_m: float, index: float, *, metal: bool = False) -> complex:
    """Return the relative permittivity of a material of which a wave knows loss and refractive index."""
    if metal:
        return METAL
    # A wave exp(-j k n z) loses exp(-k kappa z), kappa being the imaginary part of n, turned round.
    return complex((index - 1j * loss_db_per_m / NEPER_DB / WAVENUMBER) ** 2)


def fresnel(relative_permittivity: Complexes | complex, cosine: Floats) -> tuple[Complexes, Complexes]:
    """Return the reflection coefficients of the field across and in the plane of incidence, same shape as `cosine`.

    `cosine` is that of the angle to the surface's normal. In the plane the sign is the magnetic field's: a perfect
    conductor has -1 and +1 (ITU-R P.2040-3, equations 31a and 31b).
    """
    inside = np.sqrt(relative_permittivity - (1 - cosine**2) + 0j)
    along = relative_permittivity * cosine
    return (cosine - inside) / (cosine + inside), (along - inside) / (along + inside)


def roughness_factor(height_m: Floats | float, cosine: Floats) -> Floats:
    """Return the share of the specular field that is left by heights of this standard deviation (Ament 1953)."""
    return np.asarray(np.exp(-2 * (WAVENUMBER * height_m * cosine) ** 2))
