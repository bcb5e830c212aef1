"""Makes the twin of a recording, a scenario fitted to it, and compares the two distribution by distribution."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from pydantic import ValidationError
from scipy.special import kolmogorov
from threadpoolctl import threadpool_limits

from uwblink.arrays import Floats, Ints
from uwblink.output import check_output, write_text
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.run import simulate
from uwbsim.tables import write_csv
from uwbsim.twins.calibration_file import CalibrationSource, KnownDevices, read_calibration
from uwbsim.twins.clocks import fit_clocks
from uwbsim.twins.flight import Flight, RecordingSource, effective_size, fit_schedule, lag_one, read_flight, some_rows
from uwbsim.twins.powers import fit_powers
from uwbsim.twins.reflections import fit_reflections
from uwbsim.twins.scenario import Fitted, receive_noise, scenario_text, tables, unknowns

LEVEL: Final = 0.01
"""Below this probability chance does not explain a difference."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One quantity in a recording and in its twin.

    Quantiles are of all values; `lag1_*` is the autocorrelation to the pair's next value, about the mean of all.
    `worth_*` is how many independent values the values are worth, `distance` the largest difference of the cumulative
    shares, and `probability` how likely chance makes it as large as that where both are the same (Kolmogorov and
    Smirnov, with sizes as the values are worth). `alike` says whether that is more than `LEVEL`.
    """

    name: str
    unit: str
    measured: Floats
    simulated: Floats
    count: int
    median_measured: float
    median_simulated: float
    low_measured: float
    low_simulated: float
    high_measured: float
    high_simulated: float
    lag1_measured: float
    lag1_simulated: float
    worth_measured: float
    worth_simulated: float
    distance: float
    probability: float
    pairs: dict[str, dict[str, float]]

    @property
    def alike(self) -> bool:
        """Return whether chance explains the difference."""
        return self.probability > LEVEL

    def to_dict(self) -> dict[str, Any]:
        """Return the figures, JSON-ready, without the values."""
        table = asdict(self)
        values = {key: value for key, value in table.items() if key not in ("measured", "simulated")}
        numbers = {k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in values.items()}
        return numbers | {"alike": self.alike}


Column = Callable[[Flight], Floats]
QUANTITIES: Final[dict[str, tuple[str, Column]]] = {
    "reply dt32": ("us", lambda f: intervals(f.exchanges).dt32 * TICK_S * 1e6),
    "first-path power at target": ("dBm", lambda f: f.exchanges.fpp1_dbm),
    "first-path power at initiator": ("dBm", lambda f: f.exchanges.fpp2_dbm),
    "difference of the two powers": ("dB", lambda f: f.exchanges.fpp1_dbm - f.exchanges.fpp2_dbm),
    "carrier reading at initiator": ("ppm", lambda f: f.exchanges.skew2_ppm),
    "sum of both carrier readings": ("ppm", lambda f: f.exchanges.skew1_ppm + f.exchanges.skew2_ppm),
    "skew by dt64/dt53": ("ppm", lambda f: f.ratio_ppm),
    "ratio less carrier readings": ("ppm", lambda f: f.ratio_ppm - (f.exchanges.skew2_ppm - f.exchanges.skew1_ppm) / 2),
    "residual of calibrated ranges": ("m", lambda f: f.residual_m),
}
"""What is compared, of which unit, one value an exchange; columns without values are left out."""


def compare_flights(
    measured: Flight,
    known: KnownDevices,
    scenario: Scenario,
    seeds: int | None = None,
    progress: Callable[[float], None] | None = None,
) -> list[Compared]:
    """Simulate a scenario with seeds 1, 2 and so on, and compare; raises `ParameterError` for less than one seed."""
    if seeds is not None and (isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 1):
        raise ParameterError(f"found {seeds!r}, expected a whole number from 1 on", parameter="seeds")
    # Without a wish 6000 simulated exchanges or more, by eight seeds at most.
    count = seeds or int(np.clip(-(-6000 // len(measured)), 1, 8))
    flights = []
    for k in range(count):
        one = scenario.model_copy(update={"run": scenario.run.model_copy(update={"seed": k + 1})})
        flights.append(Flight.of(simulate(one), known, "the simulated twin", fewest=2))
        if progress:
            progress((k + 1) / count)
    found = [_compared(name, measured, flights) for name in QUANTITIES]
    return [one for one in found if one is not None]


def _compared(name: str, measured: Flight, flights: list[Flight]) -> Compared | None:
    unit, column = QUANTITIES[name]
    mine, group = _finite(column(measured), measured.pair)
    parts = [_finite(column(flight), flight.pair) for flight in flights]
    if len(mine) < 8 or not all(len(values) for values, _ in parts):
        return None
    # A seed's pairs are pairs of their own.
    span = max(int(pairs.max()) for _, pairs in parts) + 1
    theirs = np.concatenate([values for values, _ in parts])
    theirs_group = np.concatenate([pairs + k * span for k, (_, pairs) in enumerate(parts)])
    worth = effective_size(mine, group), float(sum(effective_size(*part) for part in parts))
    # The largest difference of the two cumulative shares.
    at = np.sort(np.concatenate([mine, theirs]))
    shares = [np.searchsorted(np.sort(values), at, side="right") / len(values) for values in (mine, theirs)]
    distance = float(np.max(np.abs(shares[0] - shares[1])))
    low, middle, high = ([float(np.quantile(values, level)) for values in (mine, theirs)] for level in (0.1, 0.5, 0.9))
    shown = 4000  # values of each side for pictures
    return Compared(
        name=name,
        unit=unit,
        measured=mine[some_rows(len(mine), shown)],
        simulated=theirs[some_rows(len(theirs), shown)],
        count=len(mine),
        median_measured=middle[0],
        median_simulated=middle[1],
        low_measured=low[0],
        low_simulated=low[1],
        high_measured=high[0],
        high_simulated=high[1],
        lag1_measured=lag_one(mine, group),
        lag1_simulated=lag_one(theirs, theirs_group),
        worth_measured=worth[0],
        worth_simulated=worth[1],
        distance=distance,
        probability=float(kolmogorov(distance * np.sqrt(worth[0] * worth[1] / (worth[0] + worth[1])))),
        pairs=_by_pair(measured, column(measured), [(flight, column(flight)) for flight in flights]),
    )


def _finite(values: Floats, pair: Ints) -> tuple[Floats, Ints]:
    good = np.isfinite(values)
    return np.asarray(values[good], dtype=np.float64), pair[good]


def _by_pair(measured: Flight, values: Floats, simulated: list[tuple[Flight, Floats]]) -> dict[str, dict[str, float]]:
    """Return medians, 90 % quantiles and autocorrelations of both sides by pair."""
    found = {}
    for k, pair in enumerate(measured.pairs):
        mine = values[measured.pair == k]
        theirs = [
            column[flight.pair == flight.pairs.index(pair)] for flight, column in simulated if pair in flight.pairs
        ]
        if not theirs:
            continue
        groups = np.repeat(np.arange(len(theirs)), [len(part) for part in theirs])
        together = np.concatenate(theirs)
        found[f"{pair[0]}-{pair[1]}"] = {
            "count": float(len(mine)),
            "median_measured": float(np.median(mine)),
            "median_simulated": float(np.median(together)),
            "high_measured": float(np.quantile(mine, 0.9)),
            "high_simulated": float(np.quantile(together, 0.9)),
            "lag1_measured": lag_one(mine, np.zeros(len(mine), np.int64)),
            "lag1_simulated": lag_one(together, groups),
        }
    return found


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Twin:
    """A scenario fitted to a recording.

    `scenario` can be simulated as it is; `found` has what was fitted, JSON-ready; `unknown` says what the recording
    cannot tell and so keeps its default, one sentence each. `compare` simulates it beside the recording, `save` writes
    it as a file.

    >>> import calib
    >>> import uwbsim
    >>> still = [{"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0)]
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"duration_s": 4.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": name, "motion": motion} for name, motion in zip("ab", still)],
    ...         "tags": [{"id": 1, "body": "a"}, {"id": 2, "body": "b"}],
    ...     }
    ... )
    >>> found = uwbsim.twin(flight, calib.fit(calib.sample_flight()).calibration)
    >>> [one.name for one in found.compare(seeds=1)][:2]
    ['reply dt32', 'first-path power at target']
    """

    scenario: Scenario
    found: dict[str, Any]
    unknown: tuple[str, ...]
    recording: str
    calibration: str
    measured: Flight
    known: KnownDevices
    paths: dict[str, Poses]
    table: dict[str, Any]

    def compare(self, seeds: int | None = None, progress: Callable[[float], None] | None = None) -> list[Compared]:
        """Simulate the twin with a number of seeds, and compare it with the recording, distribution by distribution.

        Without `seeds` there are as many as make the simulated exchanges some times the measured ones.
        """
        return compare_flights(self.measured, self.known, self.scenario, seeds, progress)

    def files(self, output: str | os.PathLike[str]) -> tuple[Path, ...]:
        """Return the names of what `save` writes: the scenario, and beside it its poses and its plan where needed."""
        path = Path(output)
        poses = (path.with_suffix(".poses.uwb"),) if self.paths else ()
        plan = (path.with_suffix(".plan.csv"),) if isinstance(self.table["ranging"].get("plan"), dict) else ()
        return (path, *poses, *plan)

    def save(self, output: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the scenario (.toml) and what it names; raises what `check_output` raises, with nothing written."""
        path = Path(output)
        check_name(path)
        for file in self.files(path):
            check_output(file, force=force)
        table = _linked(self.table, path)
        if self.paths:
            order = np.argsort(np.concatenate([one.time_ns for one in self.paths.values()]), kind="stable")
            columns = ("time_ns", "body", "position_m", "quaternion")
            poses = Poses(*(np.concatenate([getattr(p, name) for p in self.paths.values()]) for name in columns))
            with Recording.create(
                path.with_suffix(".poses.uwb"), meta={"source": "uwbsim twin"}, force=force
            ) as recording:
                recording.append_tags([Tag(tag.id, tag.body, tag.lever_arm_m) for tag in self.scenario.tags])
                recording.append_poses(poses[order])
        if isinstance(table["ranging"].get("plan"), dict):
            slots = self.table["ranging"]["plan"]["slots"]
            rows = [dict(zip(("time_s", "initiator", "target"), slot, strict=True)) for slot in slots]
            write_csv(path.with_suffix(".plan.csv"), rows, force=force)
        head = (
            f"The twin of {Path(self.recording).name} with {Path(self.calibration).name}: fitted to it by "
            "`uwbsim twin`, which also wrote what lies beside this file. What nothing is said of here has its default."
        )
        write_text(path, scenario_text(table, head), force=force)

    def __repr__(self) -> str:
        """Return what was found, a line each."""
        lines = [f"Twin of {self.recording}: {len(self.measured)} exchanges of {len(self.measured.pairs)} pairs"]
        lines += [f"  {name}: {value:.4g}" for name, value in self.found.items() if isinstance(value, float)]
        return "\n".join(lines)


def twin(recording: RecordingSource, calibration: CalibrationSource) -> Twin:
    """Fit a scenario to a recording, with what a calibration knows of the devices as their truth.

    `recording` is a file (.uwb) or what one holds in memory (`uwblink.Contents`, a simulated flight); `calibration` its
    file (.json), its JSON as nested tables, or a `calib.Calibration`. The recording needs poses, first-path powers
    and some hundred exchanges. Raises `ScenarioError` where these lack or the calibration does not know all tags, and
    what `Recording.open` raises.

    >>> import calib
    >>> import uwbsim
    >>> still = [{"model": "static", "position_m": [x, 0.0, 2.0]} for x in (0.0, 5.0)]
    >>> flight = uwbsim.simulate(
    ...     {
    ...         "run": {"duration_s": 10.0},
    ...         "ranging": {"rate_hz": 50.0},
    ...         "bodies": [{"name": name, "motion": motion} for name, motion in zip("ab", still)],
    ...         "tags": [{"id": 1, "body": "a", "skew_ppm": 3.0}, {"id": 2, "body": "b"}],
    ...     }
    ... )
    >>> found = uwbsim.twin(flight, calib.fit(calib.sample_flight()).calibration)
    >>> one, two = found.scenario.tags
    >>> round(one.skew_ppm - two.skew_ppm, 1)
    3.0
    """
    known = read_calibration(calibration)
    flown, where = read_flight(recording)
    flight = Flight.of(flown, known, where)
    # One thread: the same bytes on any machine, and small matrices are quicker so.
    with threadpool_limits(limits=1, user_api="blas"):
        # More than 50,000 exchanges would only take longer for clocks and powers.
        rows = flight.some(50_000)
        clocks = fit_clocks(flight[rows])
        noise = receive_noise(flight[rows], clocks)
        std = np.sqrt(np.mean([noise.at(power) ** 2 for power in flight.power_dbm], axis=0))
        reflections = fit_reflections(flight, std)
        powers = fit_powers(flight[rows], reflections.reflected[rows])
        schedule = fit_schedule(flight, flown.faults)
    fitted = Fitted(clocks=clocks, noise=noise, reflections=reflections, powers=powers, schedule=schedule)
    name = f"twin of {Path(where).stem}"
    table, paths = tables(flight, known, flown.poses, fitted, name)
    try:
        scenario = Scenario.model_validate(table)
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise ScenarioError(f"{where}: its twin cannot be: {place}: {first['msg']}") from error
    return Twin(
        scenario=scenario,
        found=summary(flight, fitted),
        unknown=tuple(unknowns(flight, fitted)),
        recording=where,
        calibration=known.where,
        measured=flight,
        known=known,
        paths=paths,
        table=table,
    )


def summary(flight: Flight, fitted: Fitted) -> dict[str, Any]:
    """Return what was fitted by name, numbers or None, and tables by tag and by pair."""
    clocks, reflections, powers, schedule = fitted.clocks, fitted.reflections, fitted.powers, fitted.schedule
    noise = fitted.noise.std_s
    return {
        "exchanges": len(flight),
        "duration_s": float(flight.time_s[-1]),
        "rate_hz": schedule.rate_hz,
        "round_robin": schedule.regular,
        "lost_share": schedule.lost_share,
        "receive_noise_ps": float(np.mean(noise)) * 1e12 if len(noise) else None,
        "carrier_noise_ppm": clocks.carrier_std_ppm,
        "carrier_bias_ppm": clocks.carrier_bias_ppm,
        "warm_up_s": clocks.warm_up_s,
        "ratio_bias_ppm": clocks.ratio_bias_ppm,
        "first_path_at_1m_dbm": powers.at_1m_dbm,
        "path_loss_exponent": powers.exponent,
        "power_noise_db": powers.noise_db,
        "fading_db": powers.fading_db,
        "fading_life_s": powers.fading_life_s,
        "core_mean_m": reflections.core_mean_m,
        "direct_std_m": reflections.direct_std_m,
        "reflected_share": reflections.share,
        "reflected_share_between_pairs": reflections.share_std,
        "mean_excess_m": reflections.mean_excess_m,
        "reflection_life_s": reflections.life_s,
        "reflection_loss_db": powers.reflection_loss_db,
        "tags": {
            str(tag.tag): {
                "skew_ppm": float(clocks.skew_ppm[k]),
                "skew_error_ppm": float(clocks.skew_error_ppm[k]),
                "warm_up_ppm": float(clocks.warm_up_ppm[k]),
                "walk_ppm_per_sqrt_s": float(clocks.walk_ppm_per_sqrt_s[k]),
                "tx_power_db": float(powers.tx_db[k]),
                "power_offset_db": float(powers.offset_db[k]),
            }
            for k, tag in enumerate(flight.tags)
        },
        "pairs": {
            f"{a}-{b}": {
                "exchanges": int(np.count_nonzero(flight.pair == k)),
                "reflected_share": float(reflections.pair_share[k]),
                "mean_excess_m": float(reflections.pair_excess_m[k]),
                "life_s": None if reflections.life_s is None else float(reflections.pair_life_s[k]),
            }
            for k, (a, b) in enumerate(flight.pairs)
        },
    }


def check_name(path: Path) -> None:
    """Raise `ScenarioError` for an output that is no scenario file."""
    if path.suffix.lower() != ".toml":
        raise ScenarioError(f"{path}: found {path.suffix or 'no suffix'}, expected the name of a scenario file (.toml)")


def _linked(table: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the tables with names of files in the place of what is in them."""
    bodies = [
        body | {"motion": {"model": "recorded", "file": path.with_suffix(".poses.uwb").name, "body": body["name"]}}
        if body["motion"]["model"] == "recorded"
        else body
        for body in table["bodies"]
    ]
    ranging = dict(table["ranging"])
    if isinstance(ranging.get("plan"), dict):
        ranging["plan"] = {"file": path.with_suffix(".plan.csv").name}
    return table | {"bodies": bodies, "ranging": ranging}
