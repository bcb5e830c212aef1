"""Two calibrations side by side: are the delays the same within what is known of them?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from calib.calibration.model import Calibration, require_calibration
from calib.errors import UnanswerableError
from uwblink.arrays import Floats
from uwblink.ticks import SPEED_OF_LIGHT

SIGNIFICANT: Final = 0.05


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Comparison:
    """Differences second minus first, after a shift common to all delays has been taken out.

    The shift and a constant of the curve are the same thing, so only together do they mean anything: `offset_m` is
    what the second calibration adds to every range beyond the first, at equal power.
    """

    difference_ns: dict[int, float]
    std_ns: dict[int, float]
    offset_m: float
    curve_rms_m: float
    chi_square: float
    probability: float
    only_first: tuple[int, ...]
    only_second: tuple[int, ...]

    @property
    def same(self) -> bool:
        """Whether differences as large as these come by chance more than once in twenty."""
        return self.probability >= SIGNIFICANT

    def __repr__(self) -> str:
        """Return the table: a line a tag, and what it comes to."""
        return self.table()

    def table(self, first: str = "the first", second: str = "the second") -> str:
        """Return a line a tag in ns, the common shift in cm, and the verdict; `first` and `second` name the two."""
        lines = [
            f"  tag {tag:3d}  {difference:+.4f} ns  ± {1.96 * self.std_ns[tag]:.4f} (95 %)"
            for tag, difference in self.difference_ns.items()
        ]
        lines.append(
            f"offset of all ranges {100 * self.offset_m:+.1f} cm, "
            f"shape of the bias curves {100 * self.curve_rms_m:.1f} cm rms"
        )
        for name, tags in ((first, self.only_first), (second, self.only_second)):
            if tags:
                lines.append(f"only in {name}: tags {', '.join(map(str, tags))}")
        lines.append(
            f"the delays are {'the same' if self.same else 'different'}: chi-square {self.chi_square:.1f} with "
            f"{len(self.difference_ns) - 1} degrees of freedom, probability {self.probability:.3f}"
        )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return what `calib compare --json` prints."""
        return {
            "difference_ns": {str(t): d for t, d in self.difference_ns.items()},
            "std_ns": {str(t): d for t, d in self.std_ns.items()},
            "offset_m": self.offset_m,
            "curve_rms_m": self.curve_rms_m,
            "chi_square": self.chi_square,
            "probability": self.probability,
            "verdict": "same" if self.same else "different",
            "only_first": list(self.only_first),
            "only_second": list(self.only_second),
        }


def compare(first: Calibration, second: Calibration) -> Comparison:
    """Say whether the delays of two calibrations differ by more than their standard errors explain, by chi-square.

    Differences in ns are second minus first, less the shift common to all delays. Raises `UnanswerableError` where
    fewer than two tags have a determined delay in both.

    >>> import calib
    >>> first, second = (calib.fit(calib.sample_flight(seed=seed)).calibration for seed in (1, 2))
    >>> calib.compare(first, second).same
    True
    """
    require_calibration(first, "first")
    require_calibration(second, "second")
    from scipy.special import chdtrc

    if first.pair_offsets or second.pair_offsets:
        raise UnanswerableError("constants of pairs are no delays, and only delays can be compared")
    known = [{t for t in c.delays_ns if np.isfinite(c.delays_std_ns.get(t, 0.0))} for c in (first, second)]
    common = sorted(known[0] & known[1])
    if len(common) < 2:
        raise UnanswerableError(
            f"{len(common)} tags have determined delays in both calibrations, at least two are needed to compare"
        )
    delta = np.array([second.delays_ns[t] - first.delays_ns[t] for t in common])
    # The shift is the most likely one; what is left has a covariance of one rank less.
    covariance = sum(_covariance_ns2(c, common) for c in (first, second)) + 1e-12 * np.eye(len(common))
    precision = np.linalg.inv(covariance)
    weight = precision.sum(axis=0)
    shift = float(weight @ delta / weight.sum())
    score = float((delta - shift) @ precision @ (delta - shift))
    std = np.sqrt(np.maximum(np.diag(covariance - 1 / weight.sum()), 0))
    low = max(first.bias_curve.range[0], second.bias_curve.range[0])
    high = min(first.bias_curve.range[1], second.bias_curve.range[1])
    grid = np.linspace(low, max(high, low + 1e-9), 400)
    curves = second.bias_curve(grid) - first.bias_curve(grid)
    return Comparison(
        difference_ns=dict(zip(common, (delta - shift).tolist(), strict=True)),
        std_ns=dict(zip(common, std.tolist(), strict=True)),
        offset_m=shift * 1e-9 * SPEED_OF_LIGHT - float(curves.mean()),
        curve_rms_m=float(curves.std()),
        chi_square=score,
        probability=float(chdtrc(len(common) - 1, score)),
        only_first=tuple(sorted(set(first.delays_ns) - set(common))),
        only_second=tuple(sorted(set(second.delays_ns) - set(common))),
    )


def _covariance_ns2(calibration: Calibration, tags: list[int]) -> Floats:
    """Covariance of some tags' delays: as fitted where it is known, else from the standard errors alone."""
    found = np.diag([calibration.delays_std_ns.get(tag, 0.0) ** 2 for tag in tags])
    known = calibration.uncertainty
    if known is None:
        return found
    place = {tag: k for k, tag in enumerate(known.tags)}
    rows = [k for k, tag in enumerate(tags) if tag in place]
    inside = [place[tags[k]] for k in rows]
    found[np.ix_(rows, rows)] = np.array(known.delays_ns2)[np.ix_(inside, inside)]
    return found
