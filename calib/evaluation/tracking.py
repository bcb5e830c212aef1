"""What localization takes and gives: the filters' settings, the track of a body, and its errors over seeds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from calib.errors import BadInputError
from uwblink.arrays import Bools, Floats, Ints

FILTERS: Final = ("raw", "calibrated", "variance", "robust")
ROBUST: Final = "robust"


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """How the filters are set up.

    The velocity input comes at `velocity_rate_hz` with white noise of `velocity_std_mps` an axis; that is the process
    noise. Percentages depend on it: the noisier velocity, the more the ranges decide. Filters begin at the true place,
    but for noise of `initial_std_m` and an `initial_offset_m` that they do not know of. A range is taken when its
    squared innovation over its variance is below `gate` (chi-square with one degree of freedom; 10.83 is its 99.9 %
    quantile); the robust filter has no gate. A filter that cannot explain half of the ranges of the last `reopen_s`
    begins anew where they say (`multilaterate`), so that it finds back from anywhere. `seeds` are runs with other
    noise, each body and flight with its own; tracks are those of the first, `seed`.
    """

    velocity_std_mps: float = 0.3
    velocity_rate_hz: float = 100.0
    initial_std_m: float = 0.1
    initial_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    fixed_std_m: float | None = None
    gate: float = 10.83
    reopen_s: float = 1.0
    seed: int = 0
    seeds: int = 3

    def __post_init__(self) -> None:
        """Refuse what no filter can run with; raises `BadInputError`."""
        for name in ("velocity_std_mps", "velocity_rate_hz", "initial_std_m", "gate", "reopen_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInputError(f"found {getattr(self, name)!r:.40}, expected a number above 0", parameter=name)
        if not 1 <= self.seeds <= 1000:
            raise BadInputError(f"found {self.seeds!r:.40}, expected 1 to 1000", parameter="seeds")


@dataclass(frozen=True, slots=True, kw_only=True)
class Track:
    """How one filter did: times (n,), estimates and truth (n, 3), normalised errors, and what was refused.

    `std_m` (n,) is the filter's own opinion of its error: the root of the sum of its three variances. `attitude`
    (n, 4), x y z w, is the filter's input.
    """

    time_ns: Ints
    attitude: Floats
    estimate_m: Floats
    truth_m: Floats
    std_m: Floats
    nis: Floats
    nees: Floats
    accepted: Bools

    def __repr__(self) -> str:
        """Return its length and how far off it is, on one line."""
        return f"track of {len(self.time_ns)} ranges, rms error {self.rmse_m:.3f} m"

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared distance between estimate and truth."""
        return float(np.sqrt(np.mean(np.sum((self.estimate_m - self.truth_m) ** 2, axis=1))))


@dataclass(frozen=True, slots=True)
class FixedStd:
    """The fixed standard deviations of ranges, by filter, and where they come from, in words."""

    std_m: dict[str, float]
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Localization:
    """One body of one recording: a track for each of `FILTERS`, and the RMSE of each over seeds (seeds,) in metres.

    `simulated` says whether the flight was; `fixed` are the fixed variances of the filters that have one.
    """

    source: str
    body: str
    tracks: dict[str, Track]
    rmse_m: dict[str, Floats]
    fixed: FixedStd
    simulated: bool

    def __repr__(self) -> str:
        """Return how far off each filter is, over seeds, on one line."""
        found = ", ".join(f"{name} {np.mean(rmse):.3f} m" for name, rmse in self.rmse_m.items())
        return f"{self.body} of {self.source}: rms error {found}"
