"""The twin of a recording: a scenario fitted to it, and the comparison of their distributions."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from scipy.special import kolmogi, kolmogorov, ndtr, ndtri
from scipy.stats import ks_2samp
from threadpoolctl import threadpool_limits

from uwblink.arrays import Floats, Ints
from uwblink.output import check_output, write_text
from uwblink.recording.file import Recording
from uwblink.recording.schema import Poses, Tag
from uwblink.ticks import TICK_S
from uwblink.twr import intervals
from uwbsim.errors import ParameterError, ScenarioError
from uwbsim.scenario.loading import validated
from uwbsim.scenario.model import Scenario
from uwbsim.simulation.run import simulate
from uwbsim.twins.clocks import fit_clocks
from uwbsim.twins.flight import (
    RecordingSource,
    TwinFlight,
    effective_size,
    fit_schedule,
    lag_one,
    read_flight,
    some_rows,
)
from uwbsim.twins.powers import fit_powers
from uwbsim.twins.range_errors import CalibrationSource, KnownDevices, fit_range_errors, read_calibration
from uwbsim.twins.scenario import FittedFlight, receive_noise, scenario_text, tables, unknowns
from uwbsim.world.radio import lifted

TWIN_LEVEL: Final = 0.01
"""Significance level of the comparison of a quantity."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """One quantity in a recording or in its twin: the number of values, and their quantiles at 10, 50 and 90 %.

    `lag1` is the autocorrelation of consecutive values of a pair, about the mean of all, and `lag1_std` its standard
    error; `worth` is the effective number of independent values.
    """

    count: int
    low: float
    median: float
    high: float
    lag1: float
    lag1_std: float
    worth: float

    @classmethod
    def of(cls, values: Floats, pair: Ints) -> Self:
        """Return the statistics of values (n,) of pairs (n,), in order of time."""
        low, middle, high = np.quantile(values, [0.1, 0.5, 0.9]).tolist()
        lag1, error = lag_one(values, pair)
        worth = effective_size(values, pair)
        return cls(count=len(values), low=low, median=middle, high=high, lag1=lag1, lag1_std=error, worth=worth)


@dataclass(frozen=True, slots=True, kw_only=True)
class Compared:
    """One quantity in a recording and in its twin.

    `distance` is the largest difference of the cumulative distributions, and `probability` its p-value (test of
    Kolmogorov and Smirnov, with the effective numbers of values). `lag1_probability` is the p-value of the difference
    of the autocorrelations (normal). `detectable` and `lag1_detectable` are the differences that are detected with a
    probability of 90 %. `drawn` are some values of both sides, for figures; `pairs` are both sides by pair.
    """

    name: str
    unit: str
    measured: Side
    simulated: Side
    distance: float
    probability: float
    detectable: float
    lag1_probability: float
    lag1_detectable: float
    drawn: tuple[Floats, Floats]
    pairs: dict[str, tuple[Side, Side]]

    @property
    def verdict(self) -> str:
        """Return "differ" for a significant difference, "alike" for none, or "too few" if large ones are undetectable.

        A large difference of distributions is 0.2, as of two normal distributions whose means differ by half a standard
        deviation; a large difference of autocorrelations is 0.4 (judgements). Each of the two tests has half of
        `TWIN_LEVEL`.
        """
        if min(self.probability, np.nan_to_num(self.lag1_probability, nan=1.0)) < TWIN_LEVEL / 2:
            return "differ"
        return "alike" if self.detectable <= 0.2 and self.lag1_detectable <= 0.4 else "too few"

    def to_dict(self) -> dict[str, Any]:
        """Return the statistics for JSON, without the values; NaN becomes None."""
        own = ("name", "unit", "distance", "probability", "detectable", "lag1_probability", "lag1_detectable")
        found = {name: _finite_or_none(getattr(self, name)) for name in own} | _both_sides(
            self.measured, self.simulated
        )
        return found | {"verdict": self.verdict, "pairs": {k: _both_sides(*sides) for k, sides in self.pairs.items()}}


def _both_sides(measured: Side, simulated: Side) -> dict[str, Any]:
    named = (("measured", measured), ("simulated", simulated))
    return {f"{key}_{side}": _finite_or_none(v) for side, one in named for key, v in asdict(one).items()}


def _finite_or_none(value: Any) -> Any:
    return None if value != value else value


QUANTITIES: Final[dict[str, tuple[str, Callable[[TwinFlight], Floats]]]] = {
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
"""The compared quantities with their units, one value per exchange; those without values are left out."""


def _compared(name: str, measured: TwinFlight, flights: list[TwinFlight]) -> Compared | None:
    """Compare a quantity of a flight with that of simulated flights; None if there are too few values."""
    unit, column = QUANTITIES[name]
    mine, group = _finite(column(measured), measured.pair)
    # Pairs of different seeds are different groups.
    named = {pair: k for k, pair in enumerate(measured.pairs)}
    numbers = [np.array([named.get(pair, -1) for pair in flight.pairs], dtype=np.int64) for flight in flights]
    parts = [_finite(column(flight), number[flight.pair]) for flight, number in zip(flights, numbers, strict=True)]
    theirs, pair = (np.concatenate(values) for values in zip(*parts, strict=True))
    if len(mine) < 8 or not len(theirs):
        return None
    seed = np.repeat(np.arange(len(parts)), [len(values) for values, _ in parts])
    one, other = Side.of(mine, group), Side.of(theirs, pair + seed * len(named))
    pairs = {}
    for (a, b), k in named.items():
        own, rows = mine[group == k], np.flatnonzero(pair == k)
        if len(own) and len(rows):
            pairs[f"{a}-{b}"] = Side.of(own, np.zeros(len(own), np.int64)), Side.of(theirs[rows], seed[rows])
    distance = float(ks_2samp(mine, theirs, method="asymp").statistic)
    root = np.sqrt(1 / (1 / one.worth + 1 / other.worth))
    spread = float(np.hypot(one.lag1_std, other.lag1_std))
    # A difference is detected with a probability of 90 % if it exceeds the critical value by 1.28 standard deviations.
    # That of a share is at most 1/2 (times 1/root).
    tenth = float(-ndtri(0.1))
    return Compared(
        name=name,
        unit=unit,
        measured=one,
        simulated=other,
        distance=distance,
        probability=float(kolmogorov(distance * root)),
        detectable=float((kolmogi(TWIN_LEVEL / 2) + tenth / 2) / root),
        lag1_probability=float(2 * ndtr(-abs(one.lag1 - other.lag1) / max(spread, 1e-9))),
        lag1_detectable=float((-ndtri(TWIN_LEVEL / 4) + tenth) * spread),
        drawn=(mine[some_rows(len(mine), 4000)], theirs[some_rows(len(theirs), 4000)]),
        pairs=pairs,
    )


def _finite(values: Floats, pair: Ints) -> tuple[Floats, Ints]:
    good = np.isfinite(values)
    return np.asarray(values[good], dtype=np.float64), pair[good]


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Twin:
    """A scenario fitted to a recording.

    `scenario` can be simulated as it is; `found` has the fitted values, JSON-ready; `unknown` describes what the
    recording does not determine, one sentence each. `compare` compares its simulation with the recording, `save` writes
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
    measured: TwinFlight
    known: KnownDevices
    paths: dict[str, Poses]
    table: dict[str, Any]

    def compare(self, seeds: int | None = None, progress: Callable[[float], None] | None = None) -> list[Compared]:
        """Simulate the twin with a number of seeds, and compare its distributions with those of the recording.

        The default of `seeds` gives at least 6000 simulated exchanges, with at most eight seeds. Raises
        `ParameterError` if `seeds` is not a whole number above 0.
        """
        if seeds is not None and (isinstance(seeds, bool) or not isinstance(seeds, int) or seeds < 1):
            raise ParameterError(f"found {seeds!r}, expected a whole number from 1 on", parameter="seeds")
        count = seeds or int(np.clip(-(-6000 // len(self.measured)), 1, 8))
        flights = []
        for k in range(count):
            simulated = simulate(self.scenario.changed("run", seed=k + 1))
            flights.append(TwinFlight.of(simulated, self.known, "the simulated twin", fewest=2))
            if progress:
                progress((k + 1) / count)
        found = [_compared(name, self.measured, flights) for name in QUANTITIES]
        return [one for one in found if one is not None]

    def files(self, output: str | os.PathLike[str]) -> tuple[Path, ...]:
        """Return the files that `save` writes: the scenario, and files of its poses and of its plan if it has them."""
        path, parts = Path(output), {".poses.uwb": self.paths, ".plan.csv": self.table["ranging"].get("plan")}
        return (path, *(path.with_suffix(suffix) for suffix, part in parts.items() if part))

    def save(self, output: str | os.PathLike[str], *, force: bool = False) -> None:
        """Write the scenario (.toml) and the files that it names; raises the errors of `check_output` before that."""
        path, table = Path(output), dict(self.table)
        check_name(path)
        for file in self.files(path):
            check_output(file, force=force, recording=file != path and file.suffix == ".uwb")
        if self.paths:
            poses = path.with_suffix(".poses.uwb")
            with Recording.create(poses, meta={"source": "uwbsim twin"}, force=force) as recording:
                recording.append("tags", [Tag(tag.id, tag.body, tag.lever_arm_m) for tag in self.scenario.tags])
                recording.append("poses", Poses.concatenate(list(self.paths.values())).in_time_order())
            motions = {name: {"model": "recorded", "file": poses.name, "body": name} for name in self.paths}
            table["bodies"] = [body | {"motion": motions.get(body["name"], body["motion"])} for body in table["bodies"]]
        if "plan" in table["ranging"]:
            plan, slots = path.with_suffix(".plan.csv"), table["ranging"]["plan"]["slots"]
            lines = ["time_s,initiator,target", *(",".join(map(str, slot)) for slot in slots)]
            write_text(plan, "\r\n".join([*lines, ""]), force=force)
            table["ranging"] = table["ranging"] | {"plan": {"file": plan.name}}
        head = (
            f"The twin of {Path(self.measured.where).name} with {Path(self.known.where).name}: fitted to it by "
            "`uwbsim twin`, which also wrote the files named here. Missing keys have their defaults."
        )
        write_text(path, scenario_text(table, head), force=force)

    def __repr__(self) -> str:
        """Return the fitted values, one per line."""
        head = f"Twin of {self.measured.where}: {len(self.measured)} exchanges of {len(self.measured.pairs)} pairs"
        values = (f"  {name}: {value:.4g}" for name, value in self.found.items() if isinstance(value, float))
        return "\n".join([head, *values])


def twin(recording: RecordingSource, calibration: CalibrationSource) -> Twin:
    """Fit a scenario to a recording; the delays and the bias curve of a calibration are taken as true.

    `recording` is a file (.uwb) or its contents in memory (`uwblink.Contents`, such as a simulated flight);
    `calibration` is a file (.json), its JSON as nested tables, or a `calib.Calibration`. The recording needs poses,
    first-path powers and at least 100 exchanges. Raises `ScenarioError` if these are missing or the calibration lacks a
    tag, and the errors of `Recording.open`.

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
    flight = TwinFlight.of(flown, known, where)
    # With one thread, results are the same bytes on any machine, and small matrices are faster.
    with threadpool_limits(limits=1, user_api="blas"):
        # For clocks and powers, 50,000 exchanges are enough; more take longer.
        rows = flight.some(50_000)
        clocks = fit_clocks(flight[rows])
        noise_dbm, noise_s = receive_noise(clocks.receive_noise_s, flight.exchanges.fpp2_dbm[rows])
        power = flight.power_dbm
        std_s = np.interp(lifted(power), lifted(noise_dbm), noise_s) if len(noise_s) else np.zeros_like(power)
        errors = fit_range_errors(flight, np.sqrt(np.mean(std_s**2, axis=0)))
        powers = fit_powers(flight[rows], errors.reflected[rows])
        schedule = fit_schedule(flight, flown.faults)
    fitted = FittedFlight(
        clocks=clocks, noise_dbm=noise_dbm, noise_s=noise_s, errors=errors, powers=powers, schedule=schedule
    )
    name = f"twin of {Path(where).stem}"
    table, paths = tables(flight, known, flown.poses, fitted, name)
    return Twin(
        scenario=validated(Scenario, table, f"{where}: the fitted scenario is not valid"),
        found=summary(flight, fitted),
        unknown=tuple(unknowns(flight, fitted)),
        measured=flight,
        known=known,
        paths=paths,
        table=table,
    )


def summary(flight: TwinFlight, fitted: FittedFlight) -> dict[str, Any]:
    """Return the fitted values by name (numbers or None), and tables by tag and by pair."""
    clocks, errors, powers, schedule = fitted.clocks, fitted.errors, fitted.powers, fitted.schedule
    noise = fitted.noise_s
    return {
        "exchanges": len(flight),
        "duration_s": float(flight.time_s[-1]),
        "rate_hz": schedule.rate_hz,
        "round_robin": schedule.turns is not None,
        "lost_share": schedule.lost_share,
        "receive_noise_ps": float(np.mean(noise)) * 1e12 if len(noise) else None,
        "carrier_noise_ppm": float(clocks.noise_ppm[1]),
        "carrier_bias_ppm": float(clocks.bias_ppm[1]),
        "warm_up_s": clocks.warm_up_s,
        "ratio_bias_ppm": float(clocks.bias_ppm[0]),
        "saturation_dbm": powers.saturation_dbm,
        "first_path_at_1m_dbm": powers.at_1m_dbm,
        "path_loss_exponent": powers.exponent,
        "power_noise_db": powers.noise_db,
        "fading_db": powers.fading_db,
        "fading_life_s": powers.fading_life_s,
        "mean_delay_ns": float(np.mean(list(errors.delays_ns.values()))),
        "direct_std_m": errors.direct_std_m,
        "reflected_share": errors.share,
        "reflected_share_between_pairs": float(np.std(errors.pair_share)),
        "mean_excess_m": errors.mean_excess_m,
        "excess_shape": errors.excess_shape,
        "reflection_life_s": errors.life_s,
        "reflection_loss_db": powers.reflection_loss_db,
        "tags": {
            str(tag.tag): {
                "skew_ppm": float(clocks.skew_ppm[k]),
                "skew_error_ppm": float(clocks.skew_error_ppm[k]),
                "warm_up_ppm": float(clocks.warm_up_ppm[k]),
                "walk_ppm_per_sqrt_s": float(clocks.walk_ppm_per_sqrt_s[k]),
                "delay_ns": errors.delays_ns[tag.tag],
                "tx_power_db": float(powers.tx_db[k]),
                "power_offset_db": float(powers.offset_db[k]),
            }
            for k, tag in enumerate(flight.tags)
        },
        "pairs": {
            f"{a}-{b}": {
                "exchanges": int(np.count_nonzero(flight.pair == k)),
                "reflected_share": float(errors.pair_share[k]),
                "mean_excess_m": float(errors.pair_excess_m[k]),
                "life_s": None if errors.life_s is None else float(errors.pair_life_s[k]),
            }
            for k, (a, b) in enumerate(flight.pairs)
        },
    }


def check_name(path: Path) -> None:
    """Raise `ScenarioError` if an output has not the suffix of a scenario file."""
    if path.suffix.lower() != ".toml":
        raise ScenarioError(f"{path}: found {path.suffix or 'no suffix'}, expected the name of a scenario file (.toml)")
