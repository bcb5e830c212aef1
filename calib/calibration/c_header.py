"""A calibration as a C header: tables, and one function that corrects a range as `Calibration.correct` does."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from calib.calibration.model import Calibration
from calib.calibration.runtime import PiecewiseCurve
from calib.ranges import FAINTEST_DBM, LOUDEST_DBM

_HEAD: Final = """\
/* Calibration of ranging tags: antenna delays, and bias and standard deviation of ranges by first-path power.
   Include it where ranges are corrected, and call uwb_correct(). C99 and C++; needs math.h. */
#ifndef UWB_CALIBRATION_H
#define UWB_CALIBRATION_H
#include <math.h>
#include <stddef.h>
"""

_CODE: Final = """
/* A curve's value in metres: a polynomial between each two knots, held constant where nothing was measured. */
static double uwb_curve(const double *left, const double *scale, const double *coefficients, size_t pieces,
                        size_t terms, double low, double high, double lifted)
{
    size_t piece = 0, k;
    double x = lifted < low ? low : lifted > high ? high : lifted, t, value = 0.0;
    while (piece + 1 < pieces && x >= left[piece + 1])
        piece++;
    t = (x - left[piece]) * scale[piece];
    for (k = 0; k < terms; k++)
        value = value * t + coefficients[piece * terms + k];
    return value;
}

static int uwb_measured(double power_dbm) { return power_dbm > UWB_FAINTEST_DBM && power_dbm < UWB_LOUDEST_DBM; }

static double uwb_lift(double power_dbm) { return pow(10.0, (power_dbm - UWB_ALPHA_DBM) / 10.0); }

/* Correct a range in metres by the powers of both ends in dBm (0 or NaN: not measured). Returns 0; 1 where the power is
   beyond the fitted ones; 2 where no power was measured (only the delays are corrected, sigma is NaN); -1 for a tag
   that has no delay (nothing is written). sigma_m may be NULL. */
static int uwb_correct(double range_m, double fpp1_dbm, double fpp2_dbm, int initiator, int target,
                       double *corrected_m, double *sigma_m)
{
    double first = 0.0, second = 0.0, lifted, bias;
    int k, found = 0;
    for (k = 0; k < UWB_TAGS; k++) {
        if (uwb_tag[k] == initiator) { first = uwb_delay_m[k]; found |= 1; }
        if (uwb_tag[k] == target) { second = uwb_delay_m[k]; found |= 2; }
    }
    if (found != 3)
        return -1;
    *corrected_m = range_m + 0.5 * first + 0.5 * second;
    if (sigma_m)
        *sigma_m = NAN;
    if (!uwb_measured(fpp1_dbm) && !uwb_measured(fpp2_dbm))
        return 2;
    if (!uwb_measured(fpp1_dbm))
        fpp1_dbm = fpp2_dbm;
    if (!uwb_measured(fpp2_dbm))
        fpp2_dbm = fpp1_dbm;
    lifted = UWB_LIFT_OF_MEAN ? uwb_lift((fpp1_dbm + fpp2_dbm) / 2.0)
                              : (uwb_lift(fpp1_dbm) + uwb_lift(fpp2_dbm)) / 2.0;
    bias = UWB_AT_RECEPTIONS ? (UWB_BIAS(uwb_lift(fpp1_dbm)) + UWB_BIAS(uwb_lift(fpp2_dbm))) / 2.0 : UWB_BIAS(lifted);
    *corrected_m -= bias;
    if (sigma_m)
        *sigma_m = UWB_SIGMA(lifted);
    return lifted < UWB_LOWEST || lifted > UWB_HIGHEST;
}
#endif
"""


def c_header(calibration: Calibration) -> str:
    """Return a header without anything but tables and static functions.

    Curves are written as polynomials with 17 digits, so that C and Python differ by rounding only. Both delays count
    half in a range, as in `Calibration.correct` without weights.
    """
    tags = sorted(calibration.delays_ns)
    metres = [calibration.delays_ns[tag] * 1e-9 * calibration.speed_of_light for tag in tags]
    bias = calibration.bias_curve
    lines = [
        _HEAD,
        f"#define UWB_TAGS {len(tags)}",
        f"#define UWB_ALPHA_DBM {_number(calibration.alpha_dbm)}",
        f"#define UWB_LIFT_OF_MEAN {int(calibration.lift == 'lift-of-mean')}",
        f"#define UWB_AT_RECEPTIONS {int(calibration.power_at == 'reception')}",
        f"#define UWB_LOWEST {_number(bias.range[0])}",
        f"#define UWB_HIGHEST {_number(bias.range[1])}",
        f"#define UWB_FAINTEST_DBM {_number(FAINTEST_DBM)}",
        f"#define UWB_LOUDEST_DBM {_number(LOUDEST_DBM)}",
        f"static const int uwb_tag[UWB_TAGS] = {{{', '.join(map(str, tags))}}};",
        f"static const double uwb_delay_m[UWB_TAGS] = {{{_numbers(metres)}}};",
        *_curve("bias", PiecewiseCurve(bias)),
        *_curve("sigma", PiecewiseCurve(calibration.sigma_curve)),
    ]
    return "\n".join(lines) + _CODE


def _curve(name: str, curve: PiecewiseCurve) -> list[str]:
    left, scale, rows = curve.table()
    terms = len(rows[0])
    upper = name.upper()
    return [
        f"static const double uwb_{name}_left[] = {{{_numbers(left)}}};",
        f"static const double uwb_{name}_scale[] = {{{_numbers(scale)}}};",
        f"static const double uwb_{name}_coefficients[] = {{",
        *(f"    {_numbers(row)}," for row in rows),
        "};",
        f"#define UWB_{upper}(lifted) uwb_curve(uwb_{name}_left, uwb_{name}_scale, uwb_{name}_coefficients, \\",
        f"    {len(rows)}, {terms}, {_number(curve.low)}, {_number(curve.high)}, lifted)",
    ]


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(map(_number, values))


def _number(value: float) -> str:
    """Return a literal of type double."""
    text = repr(float(value))
    return text if any(c in text for c in ".en") else f"{text}.0"
