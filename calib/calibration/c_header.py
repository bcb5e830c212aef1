"""A calibration as a C header: tables, and one function that corrects a range as `Calibration.correct` does."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

import numpy as np

from calib.calibration.applying import PiecewiseCurve
from calib.calibration.error_model import ErrorModel
from calib.calibration.model import Calibration
from calib.calibration.power_curves import Curve as PowerCurve
from calib.data.ranges import FAINTEST_DBM, LOUDEST_DBM

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
static double uwb_curve(const double *left, const double *coefficients, size_t pieces, size_t terms, double low,
                        double high, double lifted)
{
    size_t piece = 0, k;
    double x = lifted < low ? low : lifted > high ? high : lifted, t, value = 0.0;
    while (piece + 1 < pieces && x >= left[piece + 1])
        piece++;
    t = x - left[piece];
    for (k = 0; k < terms; k++)
        value = value * t + coefficients[piece * terms + k];
    return value;
}

static int uwb_measured(double power_dbm) { return power_dbm > UWB_FAINTEST_DBM && power_dbm < UWB_LOUDEST_DBM; }

static double uwb_lift(double power_dbm) { return pow(10.0, (power_dbm - UWB_ALPHA_DBM) / 10.0); }

/* The lifted power of an exchange, whose powers are made whole: one that was not measured is taken to be the other's.
   Returns 0 where neither was measured. */
static int uwb_lifted(double *fpp1_dbm, double *fpp2_dbm, double *lifted)
{
    if (!uwb_measured(*fpp1_dbm) && !uwb_measured(*fpp2_dbm))
        return 0;
    if (!uwb_measured(*fpp1_dbm))
        *fpp1_dbm = *fpp2_dbm;
    if (!uwb_measured(*fpp2_dbm))
        *fpp2_dbm = *fpp1_dbm;
    *lifted = UWB_LIFT_OF_MEAN ? uwb_lift((*fpp1_dbm + *fpp2_dbm) / 2.0)
                               : (uwb_lift(*fpp1_dbm) + uwb_lift(*fpp2_dbm)) / 2.0;
    return 1;
}

/* Correct a range in metres by the powers of both ends in dBm (0 or NaN: not measured). Returns 0; 1 where the power is
   beyond the fitted ones; 2 where no power was measured (only the delays are corrected, sigma is NaN); -1 for a tag
   that has no delay (nothing is written). sigma_m may be NULL. */
static inline int uwb_correct(double range_m, double fpp1_dbm, double fpp2_dbm, int initiator, int target,
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
    if (!uwb_lifted(&fpp1_dbm, &fpp2_dbm, &lifted))
        return 2;
    bias = UWB_AT_RECEPTIONS ? (UWB_BIAS(uwb_lift(fpp1_dbm)) + UWB_BIAS(uwb_lift(fpp2_dbm))) / 2.0 : UWB_BIAS(lifted);
    *corrected_m -= bias;
    if (sigma_m)
        *sigma_m = UWB_SIGMA(lifted);
    return lifted < UWB_LOWEST || lifted > UWB_HIGHEST;
}
"""

_ERRORS: Final = """
/* What errors to expect of corrected ranges of two tags, reflections included: their standard deviation about their
   mean, that mean (reflections make ranges long), in metres, and the share of them that are reflected. Returns 0; 2
   where no power was measured (all are NaN). */
static inline int uwb_errors(double fpp1_dbm, double fpp2_dbm, int initiator, int target, double *sigma_total_m,
                      double *mean_error_m, double *tail_share)
{
    double lifted, part = 0.0, noise, detour, away, square;
    int k = 0, pair = 0;
    *sigma_total_m = *mean_error_m = *tail_share = NAN;
    if (!uwb_lifted(&fpp1_dbm, &fpp2_dbm, &lifted))
        return 2;
    while (k + 2 < UWB_ERROR_POWERS && lifted >= uwb_error_lifted[k + 1])
        k++;
    part = (lifted - uwb_error_lifted[k]) / (uwb_error_lifted[k + 1] - uwb_error_lifted[k]);
    part = part < 0.0 ? 0.0 : part > 1.0 ? 1.0 : part;
    /* The last row is that of a pair that was not there when the calibration was made. */
    while (pair < UWB_ERROR_PAIRS && !((uwb_error_pair[pair][0] == initiator && uwb_error_pair[pair][1] == target) ||
                                       (uwb_error_pair[pair][0] == target && uwb_error_pair[pair][1] == initiator)))
        pair++;
    noise = exp(uwb_error_log_noise[k] + part * (uwb_error_log_noise[k + 1] - uwb_error_log_noise[k]) +
                uwb_error_factor[pair][0]);
    *tail_share = 1.0 / (1.0 + exp(-uwb_error_log_odds[k] - part * (uwb_error_log_odds[k + 1] - uwb_error_log_odds[k]) -
                                   uwb_error_factor[pair][1]));
    detour = uwb_error_factor[pair][2];
    *mean_error_m = (1.0 - UWB_OUTLIER_SHARE) * *tail_share * (UWB_LEAST_M + detour);
    square = (1.0 - UWB_OUTLIER_SHARE) *
                 (noise * noise +
                  *tail_share *
                      (UWB_LEAST_M * UWB_LEAST_M + 2.0 * UWB_LEAST_M * detour + UWB_DETOUR_SQUARE * detour * detour)) +
             UWB_OUTLIER_SHARE * UWB_OUTLIER_M * UWB_OUTLIER_M - *mean_error_m * *mean_error_m;
    /* Where the curve of bias is held constant, a range may be off by what it would go on by. */
    away = lifted < UWB_LOWEST    ? (UWB_LOWEST - lifted) * UWB_SLOPE_BELOW
           : lifted > UWB_HIGHEST ? (lifted - UWB_HIGHEST) * UWB_SLOPE_ABOVE
                                  : 0.0;
    *sigma_total_m = sqrt(UWB_ERROR_SCALE * UWB_ERROR_SCALE * square + away * away);
    *mean_error_m += UWB_ERROR_LOCATION_M;
    return 0;
}
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
    text = "\n".join(lines) + _CODE
    if calibration.errors:
        text += "\n" + "\n".join(_error_tables(calibration.errors, bias)) + _ERRORS
    return text + "#endif\n"


def _error_tables(model: ErrorModel, bias: PowerCurve) -> list[str]:
    slopes = bias.beyond(np.array([bias.range[0] - 1, bias.range[1] + 1]))
    log_noise, log_odds = model.logarithms
    numbers = {
        "LEAST_M": model.least_m,
        "DETOUR_SQUARE": 2 * model.long.square,
        "OUTLIER_SHARE": model.outlier_share,
        "OUTLIER_M": model.outlier_m,
        "ERROR_SCALE": model.scale,
        "ERROR_LOCATION_M": model.location_m,
        "SLOPE_BELOW": slopes[0],
        "SLOPE_ABOVE": slopes[1],
    }
    rows = {
        "lifted": model.lifted,
        "log_noise": log_noise.tolist(),
        "log_odds": log_odds.tolist(),
    }
    ends = [name.split("-") for name in model.pairs] + [["-1", "-1"]]
    factors = [(np.log(p.noise), np.log(p.odds), p.detour * model.detour_m) for p in model.pairs.values()]
    return [
        f"#define UWB_ERROR_POWERS {len(model.lifted)}",
        f"#define UWB_ERROR_PAIRS {len(model.pairs)}",
        *(f"#define UWB_{name} {_number(value)}" for name, value in numbers.items()),
        *(f"static const double uwb_error_{name}[] = {{{_numbers(row)}}};" for name, row in rows.items()),
        f"static const int uwb_error_pair[][2] = {{{', '.join(f'{{{a}, {b}}}' for a, b in ends)}}};",
        "/* Logarithms of the factors on noise and odds of a reflection, and the mean detour in metres. */",
        "static const double uwb_error_factor[][3] = {",
        *(f"    {{{_numbers(row)}}}," for row in [*factors, (0.0, 0.0, model.detour_m)]),
        "};",
    ]


def _curve(name: str, curve: PiecewiseCurve) -> list[str]:
    terms, upper = len(curve.pieces[0]), name.upper()
    return [
        f"static const double uwb_{name}_left[] = {{{_numbers(curve.left)}}};",
        f"static const double uwb_{name}_coefficients[] = {{",
        *(f"    {_numbers(row)}," for row in curve.pieces),
        "};",
        f"#define UWB_{upper}(lifted) uwb_curve(uwb_{name}_left, uwb_{name}_coefficients, {len(curve.pieces)}, \\",
        f"    {terms}, {_number(curve.low)}, {_number(curve.high)}, lifted)",
    ]


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(map(_number, values))


def _number(value: float) -> str:
    """Return a literal of type double."""
    text = repr(float(value))
    return text if any(c in text for c in ".en") else f"{text}.0"
