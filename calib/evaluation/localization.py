"""Localization with and without a calibration: each body is tracked from its ranges to the others.

Four filters use the same ranges and the same velocity noise: raw and calibrated ranges with fixed variances, calibrated
ranges with the variance of the sigma curve, and calibrated ranges with the whole error model, i.e. reflections and
offsets that differ between flights (`calib.evaluation.tracking`). `calib.evaluation.onboard` needs no motion capture.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from scipy.special import chdtri

from calib.calibration.applying import heard_receptions, keep_determined, noise_m, reception_gains
from calib.calibration.document import for_json, reading_provenance
from calib.calibration.error_model import GATE
from calib.calibration.model import Calibration, CalibrationSource, given_calibration, interval
from calib.data.ranges import Ranges
from calib.data.sources import Data, Flight, load_flight, require_times
from calib.errors import UnanswerableError
from calib.evaluation.models import FilterRanges
from calib.evaluation.tracking import (
    FILTERS,
    Settings,
    Track,
    Trajectory,
    distances_in,
    problems,
    run_filters,
    used_part,
)
from calib.online import DelayStates, RangeErrors, delay_slopes, ends_of, range_errors
from uwblink.arrays import Floats
from uwblink.display import printable
from uwblink.exporters import file_names, tum_lines
from uwblink.output import write_files

if TYPE_CHECKING:
    from calib.evaluation.onboard import OnboardTrack

PAPER_RMSE_M: Final = {"raw": 0.804, "calibrated": 0.500, "variance": 0.431}
"""Mean RMSE over six scenarios (ICRA 2023, its only table), with other flights and another process noise."""

TUNED_OVER: Final = (0.04, 0.07, 0.1, 0.14, 0.2, 0.28, 0.4, 0.6, 1.0)
"""Candidates for fixed standard deviations on a training flight, in metres, about two per octave."""


@dataclass(frozen=True, slots=True)
class FixedStd:
    """The fixed standard deviations of ranges by filter, and their source in words."""

    std_m: dict[str, float]
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Localization:
    """One body of one recording: a track for each of `FILTERS`, and the RMSE of each over seeds (seeds,) in metres.

    `simulated` tells whether the flight was simulated; `fixed` are the fixed standard deviations; `arrivals` counts
    differences of arrival among the measurements.
    """

    source: str
    body: str
    tracks: dict[str, Track]
    rmse_m: dict[str, Floats]
    fixed: FixedStd
    simulated: bool
    arrivals: int = 0

    @property
    def label(self) -> str:
        """The name of the body in names of files."""
        return self.body

    @property
    def delays(self) -> Mapping[int, tuple[float, float]]:
        """The delays at the end and their standard deviations, by tag in ns, empty if delays are not states."""
        return self.tracks["online"].delays if "online" in self.tracks else {}

    def trajectories(self) -> dict[str, Trajectory]:
        """Return the trajectory of each filter and the true one, by name without spaces."""
        found = {name.replace(",", "").replace(" ", "-"): one.trajectories()[""] for name, one in self.tracks.items()}
        return found | {kind: own for kind, own in self.tracks["raw"].trajectories().items() if kind}

    def __repr__(self) -> str:
        """Return the RMSE of each filter, over seeds, on one line."""
        found = ", ".join(f"{name} {np.mean(rmse):.3f} m" for name, rmse in self.rmse_m.items())
        return f"{self.body} of {self.source}: rms error {found}"


@dataclass(frozen=True, slots=True)
class LocalizationModel:
    """A motion model: its settings, its function for localization, and the printed form of its results.

    `localize` takes data, a calibration and settings, and returns a list; `table` makes JSON of that list, and `text`
    lines of the list and the settings.
    """

    settings: Callable[..., Any]
    localize: Callable[..., list[Any]]
    table: Callable[[list[Any]], Any]
    text: Callable[[list[Any], Any], str]


def localize(
    data: Data | Flight,
    calibration: CalibrationSource,
    settings: Settings | None = None,
    *,
    training: Data | Flight | None = None,
) -> list[Localization]:
    """Track every moving body of a recording that ranges, one at a time, with extended Kalman filters.

    `Settings(use="receptions")` also uses overheard frames, which localize a body that only listens.

    `data` is the path of a recording, an open `Recording`, or anything with `exchanges`, `poses` and `tags`. The fixed
    variances are the best ones on the flight `training`; without it the variances of the fitted errors, which the
    calibration contains; never those of the flight itself, which are unknown during a flight. Raises the errors of
    `Calibration.apply`, and `UnanswerableError` if no body moves or the recording has no poses.

    >>> import calib
    >>> known = calib.fit(calib.sample_flight()).calibration
    >>> found = calib.localize(calib.sample_flight(seed=2), known)
    >>> [one.body for one in found]
    ['robot1', 'robot2', 'robot3']
    >>> found[0].tracks["calibrated"].rmse_m < 0.1
    True
    """
    calibration = given_calibration(calibration)
    chosen = settings or Settings()
    flight = _flight_for(data, calibration, chosen)
    flight = replace(flight, ranges=keep_determined(calibration, flight.ranges))
    fixed = fixed_std(calibration, chosen, training)
    require_times(flight.ranges)
    bodies = problems(flight)
    if not bodies:
        raise UnanswerableError(
            f"{flight.ranges.source}: no moving body among {len(flight.poses)} poses has ranges, so there is nothing "
            f"to localize; add poses (`uwblink poses`); a body that only listens needs `use` receptions"
        )
    found = []
    for problem in bodies:
        measured = filter_ranges(problem.ranges, calibration, fixed, online=chosen.online)
        tracks = run_filters(problem, {name: one.at(problem.rows) for name, one in measured.items()}, chosen)
        found.append(
            Localization(
                source=flight.ranges.source,
                body=problem.body,
                tracks={name: own[0] for name, own in tracks.items()},
                rmse_m={name: np.array([track.rmse_m for track in own]) for name, own in tracks.items()},
                fixed=fixed,
                simulated=flight.ranges.planted is not None,
                arrivals=int(np.count_nonzero(problem.heard)),
            )
        )
    return found


def _flight_for(data: Data | Flight, calibration: Calibration, settings: Settings) -> Flight:
    """Return the part of a flight that `settings` use."""
    flight = (
        data if isinstance(data, Flight) else load_flight(data, need_power=calibration.needs_power, use=settings.use)
    )
    return replace(flight, ranges=used_part(flight.ranges, settings.use))


@dataclass(frozen=True, slots=True)
class MeasuredReceptions:
    """The components of the errors of n measurements, raw and corrected, in metres.

    An error is the sum of `sign` (n, k) times the errors of `parts` (ranges, or receptions with an independent variance
    of `gain` (n, k) times the variance of a range) and a common error of the measurements of an exchange, with a
    standard deviation of `common_m` (n,) times that of a range.
    """

    raw_m: Floats
    corrected_m: Floats
    parts: list[Ranges]
    sign: Floats
    gain: Floats
    common_m: Floats

    @classmethod
    def of(cls, ranges: Ranges, calibration: Calibration) -> MeasuredReceptions:
        """Return the components for ranges, and then for their arrivals."""
        applied, sign, none = calibration.apply(ranges), distances_in(ranges)[1], np.zeros(len(ranges))
        # Without stamps a difference has 5 times the variance of a range, unless only differences were fitted.
        whole = [1.0, 0.0] if calibration.provenance.get("exchanges") == 0 else [2.5, 2.5]
        own = np.where(ranges.differences[:, None], whole[: sign.shape[1]], sign[: len(ranges)])
        if ranges.arrivals is None:
            return cls(applied.raw_m, applied.corrected_m, [ranges] * sign.shape[1], sign, own, none)
        heard = calibration.correct_arrivals(ranges)
        return cls(
            np.append(applied.raw_m, heard.raw_m),
            np.append(applied.corrected_m, heard.corrected_m),
            [Ranges.concatenate([ranges, part]) for part in heard_receptions(ranges)[:2]],
            sign,
            np.concatenate([own, reception_gains(ranges.arrivals)]),
            np.append(none, heard.shared_m),
        )

    def own_m(self, std_m: Floats | float) -> Floats:
        """Return the standard deviation of independent errors (n,) for given deviations (n, k) of ranges like the
        parts.
        """
        return np.asarray(np.sqrt(np.sum(self.gain * np.square(std_m), axis=1)))

    def fixed(self, measured_m: Floats, std_m: float) -> FilterRanges:
        """Return the measurements for a filter that assumes one standard deviation for all ranges."""
        common_m = np.where(self.common_m > 0, std_m, 0.0)
        return FilterRanges(measured_m, self.own_m(std_m), common_m, np.zeros_like(self.sign))

    def robust(self, calibration: Calibration) -> tuple[FilterRanges, Floats, RangeErrors]:
        """Return the measurements for a filter with an error model and the noise of ranges like the parts (n, k)."""
        noises, kinds = zip(*(range_errors(calibration, part) for part in self.parts), strict=True)
        noise, shares, detours = (
            np.column_stack(some) for some in (noises, [one.share for one in kinds], [one.detour_m for one in kinds])
        )
        errors = replace(kinds[0], share=np.abs(self.sign) * shares, detour_m=detours)
        measured = self.corrected_m - errors.location_m * self.sign.sum(axis=1)
        nothing = np.zeros_like(self.sign)
        return FilterRanges(measured, self.own_m(noise), self.common_m, nothing, errors=errors), noise, errors


def filter_ranges(
    ranges: Ranges, calibration: Calibration, fixed: FixedStd, *, online: bool = False
) -> dict[str, FilterRanges]:
    """Return the measurements of each of `FILTERS`: ranges, then arrivals.

    The robust filter needs an error model, and has a rival with offsets of pairs that differ between flights. The
    filter with `online` delays is the robust one, or the one with a variance.
    """
    known, model = MeasuredReceptions.of(ranges, calibration), calibration.errors
    corrected, sign, common = known.corrected_m, known.sign, known.common_m
    nothing = np.zeros_like(sign)
    sigma = np.column_stack([noise_m(calibration, part) for part in known.parts])
    found = {
        "raw": known.fixed(known.raw_m, fixed.std_m["raw"]),
        "calibrated": known.fixed(corrected, fixed.std_m["calibrated"]),
        "variance": FilterRanges(corrected, known.own_m(sigma), common, nothing),
    }
    if model is None:
        return found | with_delays(found["variance"], ranges, calibration, online=online)
    found["robust"], noise, errors = known.robust(calibration)
    if lasting := model.lasting:
        # Receptions have independent noise: only reflections last in differences of arrival. A gate accepts longer ones
        # there, because differences have five times the variance of ranges.
        heard = np.abs(sign).sum(axis=1) > 1
        own, shared = np.where(heard, [[1.0], [0.0]], np.sqrt([[lasting.own_variance], [lasting.lasting_variance]]))
        gate_m = np.sqrt(GATE) * np.hypot(known.own_m(sigma), common) * heard
        detours_m2 = errors.share * model.square_below_m2(errors.detour_m, gate_m[:, None])
        centred = corrected - lasting.mean * np.sum(sign * sigma, axis=1)
        # The mixture contains reflections within the gate, so the total variance is the variance of the noise.
        units = np.ones(len(sign)), np.hypot(own, shared)
        both = centred, found["robust"].measured_m
        for name, one, std, unit in zip(("variance", "robust"), both, (sigma, noise), units, strict=True):
            found[name] = replace(
                found[name],
                measured_m=one,
                std_m=own / unit * known.own_m(std),
                shared_m=sign * np.sqrt((shared / unit)[:, None] ** 2 * std**2 + detours_m2),
                lasting_s=lasting.time_s,
                renewal_s=lasting.renewal_s,
            )
    if model.between_m:
        found["robust without offsets"] = replace(found.pop("robust"), shown=False)
        found["robust"] = replace(found["robust without offsets"], offset_m=model.between_m, rivals=1, shown=True)
    return found | with_delays(found["robust"], ranges, calibration, online=online)


def with_delays(
    measured: FilterRanges, ranges: Ranges, calibration: Calibration, *, online: bool
) -> dict[str, FilterRanges]:
    """Return the measurements of a filter, ranges and then arrivals, as "online" with delays as states."""
    if not online:
        return {}
    states = DelayStates.of(calibration, ranges.tags())
    slopes = states.slopes(ends_of(ranges), delay_slopes(ranges))
    one = replace(measured, offset_m=0.0, delays=states, delay_slopes=slopes, rivals=measured.rivals + 1)
    return {"online": one}


def fixed_std(calibration: Calibration, settings: Settings, training: Data | Flight | None = None) -> FixedStd:
    """Return the fixed standard deviations of raw and calibrated ranges, from data before the flight.

    In this order: the given one; those with the smallest RMSE on a training flight; those of the errors that the
    calibration was fitted to; without any (surveys, imported calibrations), sigma in the middle of its curve.
    """
    if settings.fixed_std_m is not None:
        return FixedStd(dict.fromkeys(("raw", "calibrated"), settings.fixed_std_m), "given")
    known = calibration.provenance.get("error_std_m")
    if training is None and isinstance(known, dict) and {"raw", "corrected"} <= set(known):
        with reading_provenance():
            std = {"raw": float(known["raw"]), "calibrated": float(known["corrected"])}
        return FixedStd(std, "from the fitted errors")
    if training is None:
        middle = float(calibration.sigma_curve(np.array([np.mean(calibration.sigma_curve.range)]))[0])
        return FixedStd(dict.fromkeys(("raw", "calibrated"), middle), "from the middle of the sigma curve")
    flight = _flight_for(training, calibration, settings)
    # About a minute of three bodies is enough: neighbouring candidates differ little.
    flight = replace(flight, ranges=flight.ranges[:7500])
    squares = np.zeros((2, len(TUNED_OVER)))
    for problem in problems(flight):
        known = MeasuredReceptions.of(problem.ranges, calibration)
        measured = enumerate((known.raw_m, known.corrected_m))
        ranges = {f"{k}, {s}": known.fixed(own, s).at(problem.rows) for k, own in measured for s in TUNED_OVER}
        errors = [[track.rmse_m for track in own] for own in run_filters(problem, ranges, settings).values()]
        squares += np.sum(np.square(errors), axis=1).reshape(squares.shape)
    raw, calibrated = (TUNED_OVER[k] for k in np.argmin(squares, axis=1))
    return FixedStd({"raw": raw, "calibrated": calibrated}, f"tuned on the flight {flight.ranges.source}")


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationSummary:
    """Over all bodies of all recordings: mean RMSE by filter, its reduction, mean NEES by filter, and for the variance
    filter mean NIS and NEES with their bounds.

    `rmse_m` are means over seeds, too, `spread_m` standard deviations over seeds of the mean over bodies (NaN of one
    seed). `nis` is over accepted ranges, of which a gate at 99.9 % leaves 0.99; `nees` should be 3, a state's size.
    `nis_bounds` and `nees_bounds` hold 95 % of such means if the filter is consistent: chi-square over the number of
    independent values (Bar-Shalom, Li and Kirubarajan 2001, section 5.4), with one NEES per correlation time of the
    error. `nis_inside` and `nees_inside` are the shares of single values within their 95 % bounds.
    """

    rmse_m: dict[str, float]
    spread_m: dict[str, float]
    reduction: dict[str, float]
    nees_by_filter: dict[str, float]
    nis: float
    nis_bounds: tuple[float, float]
    nis_inside: float
    nees: float
    nees_bounds: tuple[float, float]
    nees_inside: float
    accepted: float


def rmse_rows(
    found: list[Localization], total: LocalizationSummary, spread: str = "its spread over seeds"
) -> list[list[str]]:
    """Return a row for each body of the RMSE by filter, and rows of their mean, its spread, and its reduction.

    `spread` is the title of the spread, which is omitted for a single seed.
    """
    names, several = list(total.rmse_m), len(found[0].rmse_m["raw"]) > 1
    numbers = [
        *((f"{one.source} {one.body}", {name: one.rmse_m[name].mean() for name in names}) for one in found),
        ("mean", total.rmse_m),
        *([(spread, total.spread_m)] if several else []),
    ]
    rows = [[title, *(f"{row[name]:.3f}" for name in names)] for title, row in numbers]
    return [*rows, ["against raw", "", *(f"{-100 * less:+.0f} %" for less in total.reduction.values())]]


def nees_row(total: LocalizationSummary) -> list[str]:
    """Return a row of the mean NEES by filter."""
    values = ("-" if value != value else f"{value:.1f}" for value in total.nees_by_filter.values())
    return ["mean NEES (3 expected)", *values]


def summarize(found: list[Localization]) -> LocalizationSummary:
    """Return means over bodies and recordings, with equal weights as in the paper.

    Raises `UnanswerableError` if the filter accepted no range.
    """
    filters = [name for name in FILTERS if all(name in one.tracks for one in found)]
    means = {name: np.mean([one.rmse_m[name] for one in found], axis=0) for name in filters}
    rmse = {name: float(np.mean(over)) for name, over in means.items()}
    last = [one.tracks["variance"] for one in found]
    nis = np.concatenate([track.nis[track.accepted] for track in last])
    nees, nees_bounds, nees_inside = consistency(last)
    if not len(nis):
        names = ", ".join(f"{one.source}: {one.body}" for one in found)
        raise UnanswerableError(
            f"{names}: all ranges are outside the gate of the filter; check the recording with `calib doctor`"
        )
    return LocalizationSummary(
        rmse_m=rmse,
        spread_m={name: float(np.std(over, ddof=1)) if len(over) > 1 else np.nan for name, over in means.items()},
        reduction={name: 1 - rmse[name] / rmse["raw"] for name in filters[1:]},
        nees_by_filter={name: consistency([one.tracks[name] for one in found])[0] for name in filters},
        nis=float(np.mean(nis)),
        nis_bounds=_mean_bounds(len(nis), 1),
        nis_inside=_inside(nis, 1),
        nees=nees,
        nees_bounds=nees_bounds,
        nees_inside=nees_inside,
        accepted=float(np.mean([np.mean(track.accepted) for track in last])),
    )


def consistency(tracks: Sequence[Track]) -> tuple[float, tuple[float, float], float]:
    """Return the mean NEES of tracks, its 95 % bounds, and the share of single values within their 95 % bounds.

    Without truth they are NaN.
    """
    known = [track.nees[np.isfinite(track.nees)] for track in tracks]
    nees, degrees = np.concatenate(known), tracks[0].DEGREES
    if not len(nees):
        return np.nan, (np.nan, np.nan), np.nan
    bounds = _mean_bounds(sum(_independent(one) for one in known if len(one)), degrees)
    return float(np.mean(nees)), bounds, _inside(nees, degrees)


def _mean_bounds(count: float, degrees: int) -> tuple[float, float]:
    """Return the 95 % bounds of the mean of `count` independent chi-squares."""
    some = max(count, 1.0)
    low, high = chdtri(some * degrees, [0.975, 0.025]) / some
    return float(low), float(high)


def _inside(values: Floats, degrees: int) -> float:
    low, high = _mean_bounds(1.0, degrees)
    return float(np.mean((values >= low) & (values <= high)))


def _independent(values: Floats) -> float:
    """Return the effective number of independent values of a correlated series: n over the sum of its autocorrelations.

    The sum ends where the autocorrelation first falls below a twentieth.
    """
    centred = values - values.mean()
    # Zeros double the length, because the correlation by spectra is circular.
    correlation = np.fft.irfft(np.abs(np.fft.rfft(centred, 2 * len(centred))) ** 2)[: len(centred)]
    correlation = correlation / max(float(correlation[0]), 1e-300)
    end = int(np.argmax(np.append(correlation, 0.0) < 0.05))
    return len(centred) / (1 + 2 * float(correlation[1:end].sum()))


def localization_text(found: list[Localization], settings: Settings) -> str:
    """Return the table that `calib localize` prints, a row per body, with the settings below."""
    summary, fixed = summarize(found), found[0].fixed
    numbers = rmse_rows(found, summary, f"its spread over {settings.seeds} seeds")
    rows = [["RMSE of the position (m)", *summary.rmse_m], *numbers, nees_row(summary)]
    first = max(30, *(len(row[0]) + 1 for row in rows))
    table = [f"{printable(name):{first}s}" + "".join(f"{cell:>12s}" for cell in cells) for name, *cells in rows]
    paper = ", ".join(f"{value:.3f}" for value in PAPER_RMSE_M.values())
    what = "simulated flights" if all(one.simulated for one in found) else "other flights"
    lines = [
        *table,
        f"process noise: velocity with {settings.velocity_std_mps:g} m/s an axis at {settings.velocity_rate_hz:g} Hz "
        "(chosen as for optical flow of a small drone; the gain of a calibration depends on it)",
        f"fixed standard deviations, {fixed.source}: raw {fixed.std_m['raw']:.3f} m, calibrated "
        f"{fixed.std_m['calibrated']:.3f} m",
        f"ICRA 2023 reports {paper} m for its own real flights and another process noise; these are {what}, so the "
        f"values in metres cannot be compared",
        f"with the calibrated variance: NIS {summary.nis:.2f} (1 expected, 95 % bounds {summary.nis_bounds[0]:.2f} to "
        f"{summary.nis_bounds[1]:.2f}), NEES {summary.nees:.2f} (3 expected, {summary.nees_bounds[0]:.2f} to "
        f"{summary.nees_bounds[1]:.2f}), {100 * summary.accepted:.1f} % of the ranges pass the gate",
        *(line for one in found for line in offset_lines(f"{one.source} {one.body}", one.tracks.get("robust"))),
        *(line for one in found for line in delay_lines(f"{one.source} {one.body}", one.tracks.get("online"))),
    ]
    if arrivals := sum(one.arrivals for one in found):
        every = sum(len(one.tracks["raw"].time_ns) for one in found)
        lines.append(f"by {every - arrivals} ranges and {arrivals} differences of arrival")
    return "\n".join(lines)


def localization_json(found: list[Localization]) -> dict[str, Any]:
    """Return what `calib localize --json` prints: RMSE by body, filter and seed in metres, and the summary."""
    rows = [
        {
            "recording": one.source,
            "body": one.body,
            "rmse_m": {name: float(rmse.mean()) for name, rmse in one.rmse_m.items()},
            "rmse_by_seed_m": {name: rmse.tolist() for name, rmse in one.rmse_m.items()},
            "fixed_std_m": one.fixed.std_m,
            "fixed_std_source": one.fixed.source,
            "simulated": one.simulated,
            "arrivals": one.arrivals,
            **({"pair_offsets": float(np.mean(one.tracks["robust"].offsets))} if "robust" in one.tracks else {}),
            **delays_json(one.tracks.get("online")),
        }
        for one in found
    ]
    return {"scenarios": rows, "summary": for_json(asdict(summarize(found)))}


def delay_lines(title: str, track: Track | None) -> list[str]:
    """Return a line with delays at the end of a track and 95 % intervals, and one with the probability that they drift;
    none if delays are not states."""
    if track is None or not track.delays:
        return []
    each = ", ".join(f"{tag}: {delay:+.3f} {interval(std, 3)}" for tag, (delay, std) in track.delays.items())
    end, mean = 100 * track.drifts[-1], 100 * np.mean(track.drifts)
    return [
        f"delays at the end of {printable(title)} (ns): {each}",
        f"  they drift with a probability of {end:.0f} % at the end, {mean:.0f} % on average",
    ]


def offset_lines(title: str, track: Track | None) -> list[str]:
    """Return a line if it is likelier than not that pairs have constants in this flight that the calibration's flight
    did not have."""
    if track is None or not len(track.offsets) or track.offsets[-1] < 0.5:
        return []
    return [
        f"pairs of {printable(title)} have constant differences from the calibration with a probability of "
        f"{100 * track.offsets[-1]:.0f} % at the end, {100 * np.mean(track.offsets):.0f} % on average"
    ]


def delays_json(track: Track | None) -> dict[str, Any]:
    """Return delays at the end, and the mean probability that they drift, for JSON; nothing if delays are
    not states."""
    if track is None or not track.delays:
        return {}
    rows = {str(tag): {"delay_ns": one, "std_ns": for_json(std)} for tag, (one, std) in track.delays.items()}
    return {"delays": rows, "drifting": float(np.mean(track.drifts))}


def write_tum(found: Sequence[Localization | OnboardTrack], folder: Path, *, force: bool = False) -> None:
    """Write the trajectories of each body, the true one among them, into a folder, which is made if it is missing."""
    names = file_names(f"{one.source}-{one.label}" for one in found)
    files = {
        f"{name}{'-' if kind else ''}{kind}.tum": "".join(["# time x y z qx qy qz qw\n", *tum_lines(*columns)]).encode()
        for name, one in zip(names, found, strict=True)
        for kind, columns in one.trajectories().items()
    }
    write_files(folder, files, force=force)
