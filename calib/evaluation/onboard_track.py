"""What localization by what is on board takes and gives: its settings, and the track of a body."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from calib.errors import BadInputError
from calib.evaluation.onboard_filter import Noise
from uwblink.arrays import Floats, Ints

MODELS: Final = ("imu", "constant-velocity")


@dataclass(frozen=True, slots=True, kw_only=True)
class OnboardSettings:
    """How a body is localized: `model` is one of `MODELS`, `height` whether its height sensor is used.

    `start_m` is where it begins, with a standard deviation of `start_std_m` an axis, instead of where its first ranges
    say; a wrong one is left after `reopen_s`, or as many ranges as a fix takes. `headings` are tried at once;
    inertial readings are averaged to `rate_hz`. `speed_m_s` is how fast it may move at a start.

    >>> import calib
    >>> calib.OnboardSettings(start_m=(0.0, 0.0, 1.0)).model
    'imu'
    """

    model: str = "imu"
    height: bool = True
    start_m: tuple[float, float, float] | None = None
    start_std_m: float = 0.3
    reopen_s: float = 0.5
    headings: int = 8
    rate_hz: float = 50.0
    speed_m_s: float = 1.0
    noise: Noise = field(default_factory=Noise)

    def __post_init__(self) -> None:
        """Refuse what no filter can run with; raises `BadInputError`."""
        if self.model not in MODELS:
            raise BadInputError(
                f"found {self.model!r:.40}, allowed: {', '.join(MODELS)}, or poses with motion capture",
                parameter="model",
            )
        for name in ("start_std_m", "reopen_s", "rate_hz", "speed_m_s"):
            if not 0 < getattr(self, name) < np.inf:
                raise BadInputError(f"found {getattr(self, name)!r:.40}, expected a number above 0", parameter=name)
        if self.start_m is not None and not (len(self.start_m) == 3 and np.isfinite(self.start_m).all()):
            raise BadInputError(f"found {self.start_m!r:.60}, expected three numbers", parameter="start_m")


@dataclass(frozen=True, slots=True, kw_only=True)
class OnboardTrack:
    """Where a body was (n, 3), with attitudes x y z w (n, 4), from the first fix on, and what to think of it.

    `std_m` (n,) is the root of the sum of the filter's three variances. `truth_m` (n, 3), `true_attitude` (n, 4) and
    `nees` (n,) are NaN where poses do not say. `nis` (ranges,) are squared innovations over their variance at
    `range_time_ns`, `believed` those that were; `restarts_s` when the filter began anew, in seconds since the first
    exchange.
    """

    source: str
    body: str
    model: str
    used: str
    time_ns: Ints
    estimate_m: Floats
    attitude: Floats
    std_m: Floats
    truth_m: Floats
    true_attitude: Floats
    nees: Floats
    range_time_ns: Ints
    nis: Floats
    believed: Floats
    restarts_s: tuple[float, ...]

    @property
    def rmse_m(self) -> float:
        """Root of the mean squared distance from the truth, NaN where nothing is known of it."""
        known = np.isfinite(self.truth_m).all(axis=1)
        wrong = self.estimate_m[known] - self.truth_m[known]
        return float(np.sqrt(np.mean(np.sum(wrong**2, axis=1)))) if known.any() else float("nan")

    def __repr__(self) -> str:
        """Return what it rests on and how far off it is, on one line."""
        off = f"rms error {self.rmse_m:.3f} m" if self.rmse_m == self.rmse_m else "no truth to judge by"
        return f"{self.body} of {self.source} by {self.used}: {off}"
