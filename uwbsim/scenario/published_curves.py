"""Known curves of bias and standard deviation, by name.

`icra2023` and `icra2023-july` were published with Shalaby et al., ICRA 2023 (decargroup/uwb_calibration, MIT: the
paper's campaign of August 2022 and an earlier one), `miluv` with the MILUV dataset (decargroup/miluv, MIT); both over
lifted first-path power. `aps011` is Decawave's application note APS011 over received power in dBm.
"""

from __future__ import annotations

from typing import Any, Final

_AUGUST: Final = [0.014173673264269979] * 4 + [1.599984520527571] * 4
_JULY: Final = [0.009024434505913748] * 4 + [1.8988661927089594] * 4

BIAS: Final[dict[str, dict[str, Any] | None]] = {
    "none": None,
    "icra2023": {
        "knots": _AUGUST,
        "coefficients": [-0.10390405490159899, 0.19557370947637895, 0.009971128641334684, -0.08013907739130957],
    },
    "icra2023-july": {
        "knots": _JULY,
        "coefficients": [0.04966490271694489, 0.1953304643142809, -0.07314396259120787, -0.13110281313784328],
    },
    "miluv": {
        "knots": [0.01] * 4 + [1.8] * 4,
        "coefficients": [-0.07124040390869976, 0.3203602506292999, -0.17857607126613156, -0.07516134998019255],
    },
    "aps011": {
        "power_dbm": [float(-61 - 2 * k) for k in range(18)],
        "bias_m": [
            b / 1000
            for b in (-110, -105, -100, -93, -82, -69, -51, -27, 0, 21, 35, 42, 49, 62, 71, 76, 81, 86)
        ],
    },
}  # fmt: skip
"""Bias of a range in metres."""

REPLY_RATIO: Final = 0.2
"""dt32/dt53 of the boards in the flights behind the curves: 305 us to 1539 us."""

SIGMA: Final[dict[str, dict[str, Any] | None]] = {
    "none": None,
    "icra2023": {
        "knots": _AUGUST,
        "coefficients": [0.07418352595325353, 0.11438036048184572, 0.04769635492702895, 0.06499148440853658],
        "reply_ratio": REPLY_RATIO,
    },
    "icra2023-july": {
        "knots": _JULY,
        "coefficients": [0.20866472194861246, 0.08108610512201572, 0.06722711440695964, 0.07144904233331333],
        "reply_ratio": REPLY_RATIO,
    },
    "miluv": {
        "knots": [0.01] * 5 + [1.8] * 5,
        "coefficients": [
            0.18973127701786333, 0.1401417272865022, 0.3951126347143982, -0.11438027911679073, 0.12874371852672592,
        ],
        "degree": 4,
        "reply_ratio": REPLY_RATIO,
    },
}  # fmt: skip
"""Standard deviation of a double-sided range in metres, as those were from which the curves come."""
