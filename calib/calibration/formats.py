"""Calibrations in other formats: register values, tables, MILUV's JSON, YAML for ROS, a C header."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Sequence, Sized
from dataclasses import asdict
from itertools import chain
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from scipy.interpolate import PPoly

from calib.calibration.document import ends_of, finite
from calib.calibration.error_model import ErrorModel
from calib.calibration.model import Calibration, CalibrationSource, given_calibration
from calib.calibration.patterns import Pattern, TemperatureSlope
from calib.calibration.power_curves import ALPHA_DBM, Curve
from calib.data.ranges import FAINTEST_DBM, LOUDEST_DBM
from calib.data.sources import antenna_delays_in
from calib.errors import BadInputError
from uwblink.output import write_text
from uwblink.recording.antenna_delays import (
    REGISTER_MAX,
    AntennaDelay,
    AntennaDelays,
    delay_of,
    delays_differ,
    load_antenna_delays,
    text_of_delays,
)
from uwblink.recording.file import Recording
from uwblink.text_files import read_text
from uwblink.ticks import SPEED_OF_LIGHT, TICK_S, TX_SHARE


def programmed(path: str | os.PathLike[str]) -> AntennaDelays:
    """Return the antenna delays that were programmed into devices, from a recording or a file (.toml).

    Raises the errors of `Recording.open` and `load_antenna_delays`, and `BadInputError` for a recording without them.
    """
    if Path(path).suffix == ".toml":
        return load_antenna_delays(Path(path))
    with Recording.open(path) as opened:
        found = antenna_delays_in(opened.meta(), str(path))
    if not found:
        raise BadInputError(f"{path}: does not contain the antenna delays that were programmed into its devices")
    return found


def registers(
    calibration: Calibration, base: AntennaDelays | None = None, *, firmware: bool = False
) -> dict[int | None, AntennaDelay]:
    """Return the antenna delays to program into tags, in ticks.

    They are those programmed during the recording plus a correction. The former are the calibration's `antenna_delays`,
    or `base` (`programmed`) if it has none. The chip adds the transmitter's register to transmit stamps, and subtracts
    the receiver's register from receive stamps. A recorded transmit stamp is the true one plus d_t = 0.44 d, a receive
    stamp the true one plus d_r = -0.56 d, so -0.44 d is added to the transmitter's register and -0.56 d to the
    receiver's (docs/theory.md). With `firmware`, its constant for the stamps of delayed replies is set to the
    transmitter's register; otherwise it does not change. Raises `BadInputError` for values outside 16 bits, for delays
    that the data do not determine (their registers would be right only with some other devices), if the programmed
    delays are unknown, and if calibration and `base` contradict each other.
    """
    free = free_delays(calibration)
    if free:
        raise BadInputError(
            f"the data do not determine the delay of tag {', '.join(map(str, free))}, so it has no register value; "
            f"set a known delay (`fixed_ns`), or fit ranges between more tags (csv and json state what is known)",
            parameter="to",
        )
    found = _to_program(calibration, base)
    unknown = [tag for tag in calibration.delays_ns if tag not in found]
    if unknown:
        raise BadInputError(
            f"the antenna delays of tag {', '.join(map(str, sorted(unknown)))} that were programmed when the "
            "calibration was fitted are unknown; give the recording that it was fitted to, or a file of antenna delays",
            parameter="base",
        )
    return {tag: one._replace(reply=one.tx) for tag, one in found.items()} if firmware else found


def antenna_delays_warning(calibration: Calibration, path: str | os.PathLike[str]) -> str:
    """Return a warning if the antenna delays programmed during a recording differ from those of a calibration.

    Returns "" if they are equal or unknown. Raises the errors of `Recording.open`.
    """
    with Recording.open(path) as opened:
        now, tags = antenna_delays_in(opened.meta(), str(path)), [tag.tag for tag in opened.tags()]
    return delays_differ(calibration.antenna_delays, now, tags)


def free_delays(calibration: Calibration) -> list[int]:
    """Return the tags whose delays the data do not determine, including those with determined sums."""
    return [tag for tag, std in sorted(calibration.delays_std_ns.items()) if not math.isfinite(std)]


def _to_program(calibration: Calibration, base: AntennaDelays | None) -> dict[int | None, AntennaDelay]:
    """Return the antenna delays to program by tag, determined or not; tags with unknown programmed delays are left out.

    The sum of both registers is rounded, and not each of them, because ranges depend on the sum.
    """
    tags = sorted(calibration.delays_ns)
    if base is not None and (differ := delays_differ(calibration.antenna_delays, base, tags)):
        raise BadInputError(differ, parameter="base")
    then, found = {**(base or {}), **calibration.antenna_delays}, dict[int | None, AntennaDelay]()
    for tag in tags:
        before, ticks = delay_of(then, tag), round(-calibration.delays_ns[tag] * 1e-9 / TICK_S)
        if before is None:
            continue
        tx = round(TX_SHARE * ticks)
        found[tag] = AntennaDelay(before.tx + tx, before.rx + ticks - tx, before.reply)
        if not all(0 <= value <= REGISTER_MAX for value in found[tag]):
            raise BadInputError(
                f"tag {tag}: its registers would be {found[tag]}, outside 16 bits; give the recording that the "
                f"calibration was fitted to",
                parameter="base",
            )
    return found


REGISTERS_HEAD: Final = """\
# Antenna delays to program, in ticks of 15.65 ps: the transmitter's register, the receiver's, and the firmware's
# constant for the stamps of delayed replies (TX_ANT_DLY). `uwblink record --antenna-delays` takes this file.
"""


def _csv(calibration: Calibration) -> str:
    rows = [
        f"{tag},{delay!r},{calibration.delays_std_ns.get(tag, '')!s}"
        for tag, delay in sorted(calibration.delays_ns.items())
    ]
    return "\n".join(["tag,delay_ns,delay_std_ns", *rows]) + "\n"


def _miluv(calibration: Calibration) -> str:
    original = calibration.provenance.get("miluv")
    document = dict(original) if isinstance(original, dict) else {}
    document["delays_ns"] = {str(t): d for t, d in sorted(calibration.delays_ns.items())}
    for key, curve in zip(CURVES_OF_MILUV, (calibration.bias_curve, calibration.sigma_curve), strict=True):
        document[key] = {"knots": list(curve.knots), "coeffs": list(curve.coefficients), "degree": curve.degree}
    document.setdefault("tx_rx_split", {"tx": TX_SHARE, "rx": round(1 - TX_SHARE, 2)})
    document.setdefault("c_mps", SPEED_OF_LIGHT)
    return json.dumps(document, indent=1) + "\n"


def _ros_yaml(calibration: Calibration, base: AntennaDelays | None) -> str:
    to_program = {
        tag: {"tx_antenna_delay": one.tx, "rx_antenna_delay": one.rx}
        for tag, one in _to_program(calibration, base).items()
        if tag not in calibration.sides
    }
    tags = {str(t): {"delay_ns": d} | to_program.get(t, {}) for t, d in sorted(calibration.delays_ns.items())}
    document: dict[str, Any] = {
        "alpha_dbm": calibration.alpha_dbm,
        "lift": calibration.lift,
        "power_at": calibration.power_at,
        "tags": tags,
        "bias_curve": asdict(calibration.bias_curve),
        "sigma_curve": asdict(calibration.sigma_curve),
    }
    if calibration.undetermined_splits:
        document["undetermined_splits"] = [list(map(list, sides)) for sides in calibration.undetermined_splits]
    if calibration.errors:
        document["errors"] = _error_tables(calibration.errors)
    text: str = yaml.safe_dump({"uwb_calibration": document}, sort_keys=False, default_flow_style=None, width=math.inf)
    return text


def _error_tables(model: ErrorModel) -> dict[str, Any]:
    """Return tables of the error model over lifted power for each pair, and for "other" pairs."""
    lifted, pairs = np.array(model.lifted), {}
    for name in [*model.pairs, "other"]:
        first, second = np.repeat((0, 0) if name == "other" else ends_of(name), len(lifted)).reshape(2, -1)
        shapes = model.shapes(lifted, first, second)
        low, high = model.quantiles((0.025, 0.975), lifted, first, second).T
        rows = {
            "sigma_total_m": model.total_m(shapes),
            "mean_error_m": model.mean_m(shapes),
            "tail_share": shapes.tail_share,
            "low95_m": low,
            "high95_m": high,
        }
        pairs[name] = {key: row.tolist() for key, row in rows.items()}
    return {"lifted": list(model.lifted), "pairs": pairs}


_C_HEAD: Final = """\
/* Calibration of ranging tags: antenna delays, bias and standard deviation of ranges by first-path power, and patterns
   over direction. Include this file where ranges are corrected, and call uwb_correct(), or uwb_correct_toward() if
   directions are known. C99 and C++; needs math.h. */
#ifndef UWB_CALIBRATION_H
#define UWB_CALIBRATION_H
#include <math.h>
#include <stddef.h>
"""

_C_CODE: Final = """
/* The value of a curve in metres: a polynomial between two knots, constant outside the fitted powers. */
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

/* Compute the lifted power of an exchange. If one of its powers was not measured, it is replaced by the other.
   Returns 1, or 0 if neither was measured, but is needed: flat curves are the same at any power. */
static int uwb_lifted(double *fpp1_dbm, double *fpp2_dbm, double *lifted)
{
    *lifted = UWB_LOWEST;
    if (!uwb_measured(*fpp1_dbm) && !uwb_measured(*fpp2_dbm))
        return !UWB_NEEDS_POWER;
    if (!uwb_measured(*fpp1_dbm))
        *fpp1_dbm = *fpp2_dbm;
    if (!uwb_measured(*fpp2_dbm))
        *fpp2_dbm = *fpp1_dbm;
    *lifted = UWB_LIFT_OF_MEAN ? uwb_lift((*fpp1_dbm + *fpp2_dbm) / 2.0)
                               : (uwb_lift(*fpp1_dbm) + uwb_lift(*fpp2_dbm)) / 2.0;
    return 1;
}

/* Correct a range in metres, given the powers of both ends in dBm (0 or NaN: not measured). Returns 0; 1 if the power
   is outside the fitted ones; 2 if no power was measured, but is needed (only the delays are corrected, sigma is NaN);
   -1 for a tag without a delay and for a pair whose correction is not determined (nothing is written). sigma_m may be
   NULL. */
static inline int uwb_correct(double range_m, double fpp1_dbm, double fpp2_dbm, int initiator, int target,
                              double *corrected_m, double *sigma_m)
{
    double first = 0.0, second = 0.0, lifted, bias;
    int k, found = 0, sides = 0;
    for (k = 0; k < UWB_TAGS; k++) {
        if (uwb_tag[k] == initiator) { first = uwb_delay_m[k]; sides += uwb_side[k]; found |= 1; }
        if (uwb_tag[k] == target) { second = uwb_delay_m[k]; sides += uwb_side[k]; found |= 2; }
    }
    if (found != 3 || sides != 0)
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
    return UWB_NEEDS_POWER && (lifted < UWB_LOWEST || lifted > UWB_HIGHEST);
}

/* Add the spherical harmonics at a unit vector, minus their centre, to values. */
static void uwb_harmonics(const double *toward, const double *centre, double *values)
{
    const double x = toward[0], y = toward[1], z = toward[2], first = sqrt(3.0), second = sqrt(15.0);
    int k;
    values[0] += first * x;
    values[1] += first * y;
    values[2] += first * z;
    values[3] += second * x * y;
    values[4] += second * y * z;
    values[5] += second * x * z;
    values[6] += second * (x * x - y * y) / 2.0;
    values[7] += second * (z * z - 1.0 / 3.0) * first / 2.0;
    for (k = 0; k < 8; k++)
        values[k] -= centre[k];
}

/* The excess of a range by directions, relative to the average direction, in metres. toward_initiator is the unit
   vector (x, y, z) from the initiator's antenna to the target's in the frame of the initiator's body; toward_target is
   that from the target's antenna to the initiator's in the frame of the target's body. NULL or NaN: unknown.
   *unknown_m2 is the variance of the excess. */
static double uwb_pattern(int initiator, int target, const double *toward_initiator, const double *toward_target,
                          double *unknown_m2)
{
    double longer = 0.0, sum;
    int p, end, k, m;
    *unknown_m2 = 0.0;
    for (p = 0; p < UWB_PATTERNS; p++) {
        double values[8] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
        for (end = 0; end < 2; end++) {
            const double *toward = end ? toward_target : toward_initiator;
            for (k = 0; k < UWB_TAGS; k++) {
                if (!uwb_pattern_has[p][k] || uwb_tag[k] != (end ? target : initiator))
                    continue;
                sum = toward ? toward[0] + toward[1] + toward[2] : NAN;
                if (sum == sum)
                    uwb_harmonics(toward, uwb_pattern_centre[p], values);
                else
                    *unknown_m2 += uwb_pattern_rms_m[p][0] * uwb_pattern_rms_m[p][0];
            }
        }
        for (k = 0; k < 8; k++) {
            longer += uwb_pattern_m[p][k] * values[k];
            for (m = 0; m < 8; m++)
                *unknown_m2 += values[k] * uwb_pattern_m2[p][8 * k + m] * values[m];
        }
    }
    return longer;
}

/* Correct a range as uwb_correct() does, and subtract the excess by directions, uwb_pattern(). */
static inline int uwb_correct_toward(double range_m, double fpp1_dbm, double fpp2_dbm, int initiator, int target,
                                     const double *toward_initiator, const double *toward_target, double *corrected_m,
                                     double *sigma_m)
{
    double unknown_m2;
    int status = uwb_correct(range_m, fpp1_dbm, fpp2_dbm, initiator, target, corrected_m, sigma_m);
    if (status == 0 || status == 1)
        *corrected_m -= uwb_pattern(initiator, target, toward_initiator, toward_target, &unknown_m2);
    return status;
}

/* The excess of a range by the temperatures of both tags in degrees Celsius (NaN: unknown), in metres: subtract it from
   the range of uwb_correct(). *unknown_m2 is the variance of the excess: add it to the square of the standard deviation
   of uwb_errors(). */
static inline double uwb_warmth(int initiator, int target, double initiator_c, double target_c, double *unknown_m2)
{
    double longer = 0.0;
    int s, end, k;
    *unknown_m2 = 0.0;
    for (s = 0; s < UWB_SLOPES; s++) {
        double kelvin = 0.0;
        for (end = 0; end < 2; end++) {
            const double celsius = end ? target_c : initiator_c;
            for (k = 0; k < UWB_TAGS; k++) {
                if (!uwb_slope_has[s][k] || uwb_tag[k] != (end ? target : initiator))
                    continue;
                if (celsius == celsius)
                    kelvin += celsius - uwb_slope[s][2];
                else
                    *unknown_m2 += uwb_slope[s][3] * uwb_slope[s][3];
            }
        }
        longer += uwb_slope[s][0] * kelvin;
        *unknown_m2 += uwb_slope[s][1] * kelvin * uwb_slope[s][1] * kelvin;
    }
    return longer;
}
"""

_C_ERRORS: Final = """
/* The expected errors of ranges of two tags after uwb_correct_toward(), reflections included: standard deviation about
   the mean, the mean (above 0, because reflections lengthen ranges), in metres, and the probability of a reflection.
   The standard deviation includes the pattern of tags with an unknown direction. Returns 0; 2 if no power was measured
   (all are NaN). */
static inline int uwb_errors_toward(double fpp1_dbm, double fpp2_dbm, int initiator, int target,
                                    const double *toward_initiator, const double *toward_target, double *sigma_total_m,
                                    double *mean_error_m, double *tail_share)
{
    double lifted, part = 0.0, noise, detour, away, square, unknown_m2;
    int k = 0, pair = 0;
    *sigma_total_m = *mean_error_m = *tail_share = NAN;
    if (!uwb_lifted(&fpp1_dbm, &fpp2_dbm, &lifted))
        return 2;
    while (k + 2 < UWB_ERROR_POWERS && lifted >= uwb_error_lifted[k + 1])
        k++;
    part = (lifted - uwb_error_lifted[k]) / (uwb_error_lifted[k + 1] - uwb_error_lifted[k]);
    part = part < 0.0 ? 0.0 : part > 1.0 ? 1.0 : part;
    /* The last row is for pairs that were not fitted. */
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
    /* Outside the fitted powers the bias curve is constant; its linear extrapolation estimates the error of that. */
    away = lifted < UWB_LOWEST    ? (UWB_LOWEST - lifted) * UWB_SLOPE_BELOW
           : lifted > UWB_HIGHEST ? (lifted - UWB_HIGHEST) * UWB_SLOPE_ABOVE
                                  : 0.0;
    (void)uwb_pattern(initiator, target, toward_initiator, toward_target, &unknown_m2);
    *sigma_total_m = sqrt(UWB_ERROR_SCALE * UWB_ERROR_SCALE * square + away * away + unknown_m2);
    *mean_error_m += UWB_ERROR_LOCATION_M;
    return 0;
}

/* The same for ranges after uwb_correct(), without directions. */
static inline int uwb_errors(double fpp1_dbm, double fpp2_dbm, int initiator, int target, double *sigma_total_m,
                             double *mean_error_m, double *tail_share)
{
    return uwb_errors_toward(fpp1_dbm, fpp2_dbm, initiator, target, NULL, NULL, sigma_total_m, mean_error_m,
                             tail_share);
}
"""


def c_header(calibration: Calibration) -> str:
    """Return a C header with tables and static functions that correct ranges.

    Curves are written as polynomials, and numbers with all their digits, so that C and Python differ only by rounding.
    Each delay has the weight one half, as in `Calibration.correct` without `weights`.
    """
    tags = sorted(calibration.delays_ns)
    metres = [calibration.delays_ns[tag] * 1e-9 * calibration.speed_of_light for tag in tags]
    bias = calibration.bias_curve
    lines = [
        _C_HEAD,
        f"#define UWB_TAGS {len(tags)}",
        f"#define UWB_ALPHA_DBM {_number(calibration.alpha_dbm)}",
        f"#define UWB_LIFT_OF_MEAN {int(calibration.lift == 'lift-of-mean')}",
        f"#define UWB_AT_RECEPTIONS {int(calibration.power_at == 'reception' and calibration.needs_power)}",
        f"#define UWB_NEEDS_POWER {int(calibration.needs_power)}",
        f"#define UWB_LOWEST {_number(bias.range[0])}",
        f"#define UWB_HIGHEST {_number(bias.range[1])}",
        f"#define UWB_FAINTEST_DBM {_number(FAINTEST_DBM)}",
        f"#define UWB_LOUDEST_DBM {_number(LOUDEST_DBM)}",
        f"static const int uwb_tag[UWB_TAGS] = {{{', '.join(map(str, tags))}}};",
        "/* Sides of tags if only sums of delays are known: a range can be corrected if those of its tags add to 0. */",
        f"static const int uwb_side[UWB_TAGS] = {{{', '.join(str(calibration.sides.get(tag, 0)) for tag in tags)}}};",
        f"static const double uwb_delay_m[UWB_TAGS] = {{{_numbers(metres)}}};",
        *_c_curve("bias", bias),
        *_c_curve("sigma", calibration.sigma_curve),
        *_c_dependences(calibration, tags),
    ]
    text = "\n".join(lines) + _C_CODE
    if calibration.errors:
        text += "\n" + "\n".join(_c_errors(calibration.errors, bias)) + _C_ERRORS
    return text + "#endif\n"


def _c_errors(model: ErrorModel, bias: Curve) -> list[str]:
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
    rows = {"lifted": model.lifted, "log_noise": log_noise.tolist(), "log_odds": log_odds.tolist()}
    ends = [*map(ends_of, model.pairs), (-1, -1)]
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


def _c_dependences(calibration: Calibration, tags: list[int]) -> list[str]:
    """Return the tables of patterns over direction and slopes over temperature, each with a last row of zeros."""

    def owners(several: Sequence[Pattern | TemperatureSlope]) -> list[str]:
        return [", ".join(str(int(tag in one.tags)) for tag in tags) for one in several]

    patterns, slopes = calibration.patterns, calibration.temperatures
    tables = {
        "int uwb_pattern_has[][UWB_TAGS]": owners(patterns),
        "double uwb_pattern_rms_m[][1]": [_number(p.rms_m) for p in patterns],
        "double uwb_pattern_m[][8]": [_numbers(p.coefficients_m) for p in patterns],
        "double uwb_pattern_centre[][8]": [_numbers(p.centre) for p in patterns],
        "double uwb_pattern_m2[][64]": [_numbers(chain(*p.covariance_m2)) for p in patterns],
        "int uwb_slope_has[][UWB_TAGS]": owners(slopes),
        "double uwb_slope[][4]": [_numbers((s.m_per_k, s.std_m_per_k, s.reference_c, s.rms_m)) for s in slopes],
    }
    return [
        "/* Patterns over direction: whether a tag has one, root mean square, factors of harmonics, covariance.",
        "   Slopes over temperature: whether a tag has one; m/K, its standard error, reference in degrees Celsius, and",
        "   the root mean square in m. */",
        f"#define UWB_PATTERNS {len(patterns)}",
        f"#define UWB_SLOPES {len(slopes)}",
        *(
            "\n".join([f"static const {name} = {{", *(f"    {{{row}}}," for row in [*rows, "0"]), "};"])
            for name, rows in tables.items()
        ),
    ]


def _c_curve(name: str, curve: Curve) -> list[str]:
    """Return a curve as polynomials between its knots: their starts, and their coefficients from the highest power."""
    degree, count = curve.degree, len(curve.coefficients)
    whole = PPoly.from_spline((np.array(curve.knots), np.array(curve.coefficients), degree))
    pieces = [k for k in range(degree, count) if whole.x[k + 1] > whole.x[k]]  # not those between equal knots
    low, high = curve.range
    return [
        f"static const double uwb_{name}_left[] = {{{_numbers(whole.x[pieces])}}};",
        f"static const double uwb_{name}_coefficients[] = {{",
        *(f"    {_numbers(row)}," for row in whole.c[:, pieces].T),
        "};",
        f"#define UWB_{name.upper()}(lifted) uwb_curve(uwb_{name}_left, uwb_{name}_coefficients, {len(pieces)}, \\",
        f"    {degree + 1}, {_number(low)}, {_number(high)}, lifted)",
    ]


def _numbers(values: Iterable[float]) -> str:
    return ", ".join(map(_number, values))


def _number(value: float) -> str:
    """Return a C literal of type double."""
    text = repr(float(value))
    return text if any(c in text for c in ".en") else f"{text}.0"


FORMATS: Final[dict[str, Callable[[Calibration, AntennaDelays | None], str]]] = {
    "registers": lambda calibration, base: REGISTERS_HEAD + text_of_delays(registers(calibration, base)),
    "firmware": lambda calibration, base: REGISTERS_HEAD + text_of_delays(registers(calibration, base, firmware=True)),
    "json": lambda calibration, _: calibration.to_json(),
    "csv": lambda calibration, _: _csv(calibration),
    "miluv": lambda calibration, _: _miluv(calibration),
    "ros-yaml": lambda calibration, base: _ros_yaml(calibration, base),
    "c-header": lambda calibration, _: c_header(calibration),
}
"""Functions that return the text of a calibration, given it and programmed antenna delays, by format."""


def export(
    calibration: CalibrationSource,
    to: str,
    path: str | os.PathLike[str] | None = None,
    *,
    base: AntennaDelays | None = None,
    force: bool = False,
) -> str:
    """Return a calibration as text in another format, and write it to `path` if given.

    `to` is "registers" (values for the DW1000's antenna-delay registers, as TOML), "firmware" (the same, and the
    constants of the firmware's build), "json", "csv" (delays), "miluv", "ros-yaml" or "c-header" (tables and functions
    that correct a range). Registers include the antenna delays programmed during the recording: the calibration's
    `antenna_delays`, or `base` (`programmed`). Raises `BadInputError` for another format, for parts of the calibration
    that the format has no fields for (constants of pairs, groups of tags, patterns over direction, slopes over
    temperature), and the errors of `registers`.

    >>> import calib
    >>> print(calib.export(calib.fit(calib.sample_flight()).calibration, "registers").splitlines()[2])
    [antenna_delays.tags.1]
    """
    calibration = given_calibration(calibration)
    if to not in FORMATS:
        raise BadInputError(f"found {to!r}, allowed: {', '.join(FORMATS)}", parameter="to")
    lacking: tuple[tuple[Sized, Collection[str], str], ...] = (
        (calibration.pair_offsets, FORMATS.keys() - {"json"}, "no fields for constants of pairs; export it as json"),
        (
            calibration.temperatures,
            ("miluv", "ros-yaml"),
            "no fields for slopes over temperature; export it as json, or fit with `temperature` none",
        ),
        (
            calibration.patterns,
            ("miluv", "ros-yaml"),
            "no fields for patterns over direction; export it as json, or fit with `pattern` none",
        ),
        (
            calibration.groups,
            ("miluv", "ros-yaml", "c-header"),
            f"one curve for all tags, but this calibration has one for each group ({', '.join(calibration.groups)}); "
            f"export it as json",
        ),
    )
    for there, forms, why in lacking:
        if there and to in forms:
            raise BadInputError(f"{to} has {why}", parameter="to")
    text = FORMATS[to](calibration, base)
    if path is not None:
        write_text(Path(path), text, force=force)
    return text


CURVES_OF_MILUV: Final = ("bias_spline_m", "std_spline_m")


def read_miluv(path: Path) -> Calibration:
    """Read the JSON file of MILUV's published calibration; raises `BadInputError` for other content.

    Its bias curve applies to each reception (`power_at` "reception"); fitted curves here apply to the mean of an
    exchange's lifted powers. Its delays are relative to 16436 ticks in both registers, as programmed into the boards.
    Other keys are kept in the provenance and exported again.
    """
    text = read_text(path, BadInputError, "calibration of MILUV (.json)")
    try:
        table = json.loads(text, parse_float=finite, parse_constant=finite)
        bias, sigma = (_curve_table(table[key]) for key in CURVES_OF_MILUV)
        document = {
            "schema_version": 3,
            "delays_ns": table["delays_ns"],
            "delays_std_ns": {},
            # Not in the file: the authors' program fits delays with SciPy's Cauchy loss and `f_scale` 0.1 ns, and means
            # the lifted powers of both ends (above -82 dBm).
            "loss": "cauchy",
            "scale_ns": 0.1,
            "lift": "mean-of-lifted",
            "alpha_dbm": ALPHA_DBM,
            "speed_of_light": table.get("c_mps", SPEED_OF_LIGHT),
            "bias_curve": bias,
            "sigma_curve": sigma,
            "power_at": "reception",
            "antenna_delays": {tag: AntennaDelay()._asdict() for tag in table["delays_ns"]},
            "provenance": {
                "imported_from": path.name,
                "miluv": table | dict.fromkeys(("delays_ns", *CURVES_OF_MILUV)),
            },
        }
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError) as error:
        raise BadInputError(f"{path}: not a MILUV calibration ({type(error).__name__}: {error!s:.200})") from error
    return Calibration.from_json(json.dumps(document), str(path))


def _curve_table(spline: dict[str, Any]) -> dict[str, Any]:
    knots = spline["knots"]
    return {
        "knots": knots,
        "coefficients": spline["coeffs"],
        "degree": spline["degree"],
        "range": [knots[0], knots[-1]],
    }
