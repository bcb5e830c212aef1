"""Ranges with their true distances, as columns."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from calib.data.arrivals import LARGEST_ERROR_M, Arrivals
from calib.data.clocks import ClocksApart, UncorrectedSkew, clocks_apart, uncorrected_skew
from calib.errors import BadInputError, UnanswerableError
from calib.pairs import Pairs, pairs_of
from calib.spread import less_medians, robust_spread
from uwblink.arrays import Bools, ColumnTable, Floats, Ints
from uwblink.errors import ArgumentError, ImportTableError, raising, restating, warn
from uwblink.protocols.table import PROTOCOLS
from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, known_delays
from uwblink.recording.contents import Contents
from uwblink.recording.distances import distances_m, sights, tracks_of
from uwblink.recording.schema import Poses, Tag
from uwblink.twr import Exchanges, delay_weights, names_in, range_ns, raw_range, without_stamps

MapSource = str | os.PathLike[str] | Mapping[str, Any]

IN_MEMORY: Final = "memory"
"""Source of ranges that are not from a file."""

NO_STAMPS: Final = "range"
"""Protocol of ranges without stamps."""

STATIC: Final = "static"
"""Reason for ranges that `without_static` leaves out."""

FEATURES: Final = ("response_db", "rise_taps")
"""Features of impulse responses that indicate a reflection: their energy relative to that of the first path, in dB, and
the number of taps in which the first path rises from the noise to its peak. Those of an exchange are means over its
receptions.

Two others were tried and rejected. Distance in addition to power made predictions worse in 24 simulated rooms, each
predicted from the others. The chip's total power minus first-path power had a slope of the wrong sign in the public
table that has both (Hanyang), and made predictions of its held-out ranges worse.
"""

MAX_RANGE_M: Final = 1e4
"""Largest range that is used. Larger ones come from wrong stamps or another unit: ultra-wideband radios reach less than
a tenth of it."""

LEAST_TURN_RAD: Final = math.radians(45.0)
"""Smallest angle between attitudes of a body that turns. A hovering drone tilts by less (a judgement)."""

FAINTEST_DBM, LOUDEST_DBM = -140.0, -30.0
"""Bounds of received powers (judgements); other values are not measurements. A board prints 0 for a power that it could
not measure."""


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Ranges(ColumnTable):
    """Ranges with their true distances as columns of length n; `from_exchanges` and `from_arrays` make them.

    `raw_m` is the range computed from the stamps, `truth_m` the distance between the antennas; `weight_initiator` and
    `weight_target` are the derivatives of the calibrated time of flight by the antenna delays of the two tags.
    `protocol` is "range" for ranges without stamps. `session` (n,) is the number of each range's session, and
    `sessions` are their names: each recording is a session, except that recordings at the same time are one.

    `excluded` counts the ranges that were left out, by reason; `planted` are the parameters of a simulation, for
    display only; `recordings` are names and fingerprints of the recordings, empty for ranges of arrays;
    `uncorrected_skew` are errors of single-sided ranges by clock skew, None without such ranges; `clocks_apart` is the
    pair whose clock skews by stamps and by carriers differ most, None if all agree; `bodies` are pairs of a tag and its
    body; `antenna_delays` are those programmed into the tags, if known; `arrivals` are the differences of arrival at
    tags that overheard these exchanges, None without any. `toward` (n, 2, 3) are unit vectors from the antennas of
    initiator and target to each other, in the frames of their bodies, NaN if attitudes are unknown; `turning` are the
    tags on bodies that turn. `temperature_c` (n, 2) are the temperatures of initiator and target, NaN without a reading
    near in time; `features` (n, 2) are the `FEATURES` of their receptions, NaN if unknown. `supply_v_per_k` is the
    change of a tag's supply voltage per kelvin, for tags that measure both. `time_ns` is the time of an exchange, and
    `valid_ns` the time at which a changing distance equals its range (`uwblink.twr.range_ns`), by default the same.

    A row with a `listener` (-1 in others) is a difference of arrival without stamps: the listener's distance to the
    target minus its distance to the initiator. The weight of its initiator is negative.
    """

    source: str
    time_ns: Ints
    initiator: Ints
    target: Ints
    protocol: NDArray[np.str_]
    raw_m: Floats
    truth_m: Floats
    weight_initiator: Floats
    weight_target: Floats
    fpp1_dbm: Floats
    fpp2_dbm: Floats
    excluded: dict[str, int]
    planted: dict[str, Any] | None
    uncorrected_skew: UncorrectedSkew | None = None
    clocks_apart: ClocksApart | None = None
    recordings: tuple[tuple[str, str], ...] = ()
    bodies: tuple[tuple[int, str], ...] = ()
    session: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int32))
    sessions: tuple[str, ...] = ()
    antenna_delays: AntennaDelays = field(default_factory=dict)
    arrivals: Arrivals | None = None
    toward: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2, 3), dtype=np.float32))
    turning: tuple[int, ...] = ()
    temperature_c: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 2), dtype=np.float32))
    supply_v_per_k: tuple[tuple[int, float], ...] = ()
    features: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, len(FEATURES)), dtype=np.float32))
    listener: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    valid_ns: Ints = field(default_factory=lambda: np.zeros(0, dtype=np.int64))

    def __post_init__(self) -> None:
        """Fill missing columns: times of exchanges, one session, no listeners, and NaN for what is unknown."""
        count, unknown = len(self.time_ns), np.float32(np.nan)
        fillings: dict[str, tuple[Any, tuple[int, ...]]] = {
            "valid_ns": (self.time_ns, ()),
            "listener": (-1, ()),
            "session": (np.int32(0), ()),
            "toward": (unknown, (2, 3)),
            "temperature_c": (unknown, (2,)),
            "features": (unknown, (len(FEATURES),)),
        }
        for name, (value, shape) in fillings.items():
            if len(getattr(self, name)) != count:
                object.__setattr__(self, name, np.broadcast_to(value, (count, *shape)))

    @classmethod
    def from_exchanges(
        cls,
        exchanges: Exchanges,
        truth_m: Floats | None = None,
        *,
        poses: Poses | None = None,
        tags: Sequence[Tag] = (),
        planted: Mapping[str, Any] | None = None,
        source: str = IN_MEMORY,
        antenna_delays: AntennaDelays | None = None,
        temperature: Mapping[str, NDArray[Any]] | None = None,
    ) -> Ranges:
        """Return a row for every exchange; `usable` leaves out those that a fit cannot use.

        True distances are `truth_m` (n,), by default those of the exchanges. If they are not finite, they are computed
        from `poses` and the lever arms of `tags`. Impossible powers become NaN. `temperature` has the columns of a
        recording's table. Raises `BadInputError` if `truth_m` has another length than the exchanges.
        """
        truth = exchanges.truth_m if truth_m is None else np.asarray(truth_m, dtype=np.float64)
        if truth.shape != (len(exchanges),):
            raise BadInputError(f"has shape {truth.shape}, expected ({len(exchanges)},)", parameter="truth_m")
        seen: dict[str, Any] = {}
        valid_ns = range_ns(exchanges)
        if poses is not None and len(poses):
            tracks = tracks_of(poses)
            distance, toward = sights(tracks, tags, exchanges.initiator, exchanges.target, valid_ns)
            truth = np.where(np.isfinite(truth), truth, distance)
            # Tables of positions have no attitudes: all of their poses have (0, 0, 0, 1), which are no directions.
            placed = [tag for tag in tags if tag.body in tracks and not any(tag.lever_arm_m)]
            blind = [tag.tag for tag in placed if not tracks[tag.body].columns[3:6].any()]
            toward[np.isin(np.column_stack([exchanges.initiator, exchanges.target]), blind)] = np.nan
            turning = {body for body, track in tracks.items() if track.turn_rad() > LEAST_TURN_RAD}
            seen = {"toward": toward.astype(np.float32), "turning": tuple(t.tag for t in tags if t.body in turning)}
        if temperature:
            ends = np.column_stack([exchanges.initiator, exchanges.target])
            seen["temperature_c"] = read_c(temperature, ends, exchanges.time_ns)
            seen["supply_v_per_k"] = _supply_v_per_k(temperature)
        of_initiator, of_target = delay_weights(exchanges)
        bare = without_stamps(exchanges)
        return cls(
            source=source,
            time_ns=exchanges.time_ns,
            initiator=exchanges.initiator,
            target=exchanges.target,
            protocol=np.where(bare, NO_STAMPS, exchanges.protocol) if bare.any() else exchanges.protocol,
            raw_m=raw_range(exchanges),
            truth_m=truth,
            weight_initiator=of_initiator,
            weight_target=of_target,
            fpp1_dbm=measured_powers(exchanges.fpp1_dbm),
            fpp2_dbm=measured_powers(exchanges.fpp2_dbm),
            excluded={},
            planted=dict(planted) if planted else None,
            uncorrected_skew=uncorrected_skew(exchanges),
            clocks_apart=clocks_apart(exchanges),
            bodies=tuple((tag.tag, tag.body) for tag in tags),
            antenna_delays=antenna_delays or {},
            valid_ns=valid_ns,
            **seen,
        )

    @classmethod
    def from_arrays(  # noqa: PLR0913 - columns by name, most of which have a default
        cls,
        range_m: ArrayLike,
        *,
        initiator: ArrayLike,
        target: ArrayLike,
        fpp1_dbm: ArrayLike = math.nan,
        fpp2_dbm: ArrayLike | None = None,
        truth_m: ArrayLike = math.nan,
        time_ns: ArrayLike = 0,
        protocol: str = "ds",
        weights: tuple[ArrayLike, ArrayLike] = (0.5, 0.5),
        azimuth_deg: tuple[ArrayLike, ArrayLike] = (math.nan, math.nan),
        elevation_deg: tuple[ArrayLike, ArrayLike] = (0.0, 0.0),
        temperature_c: tuple[ArrayLike, ArrayLike] = (math.nan, math.nan),
        features: Mapping[str, ArrayLike] | None = None,
        source: str = IN_MEMORY,
    ) -> Ranges:
        """Return a row for every range, from arrays (n,) in metres and dBm; a single number applies to all rows.

        `truth_m` and `time_ns` are needed to fit, not to correct; powers are needed if there is a curve. A single power
        per range is `fpp1_dbm`. `weights` are those of the two delays (`uwblink.twr.delay_weights`); the default, one
        half each, assumes equal clock rates, which changes a range by less than 0.01 mm per ns of delay. `azimuth_deg`
        and `elevation_deg` are the directions from the antennas of initiator and target to each other, in the frames of
        their bodies, needed only by patterns over direction. `temperature_c` are the temperatures of initiator and
        target, `features` some of `FEATURES` by name. Raises `BadInputError` if the arrays do not have equal lengths,
        for a tag at both ends, positive powers, impossible temperatures, and unknown protocols and features.

        >>> from calib import Ranges
        >>> len(Ranges.from_arrays([3.1, 4.2], initiator=1, target=[2, 3], fpp1_dbm=-85.0))
        2
        """
        if protocol not in PROTOCOLS:
            raise BadInputError(f"found {protocol!r:.40}, allowed: {', '.join(PROTOCOLS)}", parameter="protocol")
        given = dict.fromkeys(FEATURES, math.nan) | dict(features or {})
        if len(given) > len(FEATURES):
            raise BadInputError(f"found {[*given][-1]!r:.40}, allowed: {', '.join(FEATURES)}", parameter="features")
        angles = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}
        both = {"temperature_c": temperature_c} | angles
        for name, pair in ({"weights": weights} | both).items():
            if (count := len(pair) if hasattr(pair, "__len__") else 1) != 2:
                raise BadInputError(f"found {count}, expected those of initiator and target", parameter=name)
        floats = {
            "raw_m": range_m,
            "truth_m": truth_m,
            "fpp1_dbm": fpp1_dbm,
            "fpp2_dbm": math.nan if fpp2_dbm is None else fpp2_dbm,
            **dict(zip(("weight_initiator", "weight_target"), weights, strict=True)),
            **{f"{name} {end}": pair[end] for name, pair in both.items() for end in (0, 1)},
            **given,
        }
        ints = {"initiator": initiator, "target": target, "time_ns": time_ns}
        arrays = []
        for name, column in (floats | ints).items():
            whole = name in ints
            text = f"{name.replace('raw_m', 'range_m')}: expected {'whole ' * whole}numbers"
            with raising(BadInputError, text, TypeError, ValueError):
                as_given = np.asarray(column, dtype=None if whole else np.float64)
                arrays.append(as_given.astype(np.int64, casting="same_kind") if whole else as_given)
        with raising(BadInputError, "arrays of ranges have different lengths", ValueError):
            rows = np.broadcast_arrays(*np.atleast_1d(*arrays))
        if rows[0].ndim != 1:
            raise BadInputError(f"has shape {np.shape(range_m)}, expected one dimension", parameter="range_m")
        columns: dict[str, Any] = dict(zip([*floats, *ints], rows, strict=True))
        itself = columns["initiator"] == columns["target"]
        if itself.any():
            row = int(np.argmax(itself))
            raise BadInputError(f"row {row} has tag {columns['target'][row]} at both ends", parameter="target")
        for name in ("fpp1_dbm", "fpp2_dbm"):
            if len(positive := columns[name][columns[name] > 0]):
                what = "expected powers in dBm, which are below 0; NaN or 0 stands for an unknown power"
                raise BadInputError(f"found {positive[0]:g}, {what}", parameter=name)
            columns[name] = measured_powers(columns[name])
        warm, around, up = (np.array([columns.pop(f"{name} {end}") for end in (0, 1)]).T for name in both)
        columns["temperature_c"], around, up = measured_c(warm), np.radians(around), np.radians(up)
        if len(wrong := warm[~np.isnan(warm) & np.isnan(columns["temperature_c"])]):
            raise BadInputError(f"found {wrong[0]:g}, expected degrees Celsius, -65 to 150", parameter="temperature_c")
        toward = np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=-1)
        columns["features"] = np.array([columns.pop(name) for name in FEATURES], dtype=np.float32).T
        found = cls(source=source, protocol=np.full(len(rows[0]), protocol), excluded={}, planted=None, **columns)
        if not np.isfinite(around).any():
            return found
        return replace(found, toward=toward.astype(np.float32), turning=tuple(found.tags()))

    @classmethod
    def from_dataframe(cls, frame: Any, map: MapSource | None = None) -> Ranges:  # noqa: A002 - what it is called elsewhere
        """Return the ranges of a data frame of pandas, Polars, or another with Arrow's interface, in order of time.

        Its rows are exchanges, messages or ranges, as in tables for `uwblink import csv`. `map` is a column map, as a
        path or a mapping with its keys, such as `{"columns": {"range_m": "dist"}}`; without it, the meaning of columns
        is guessed. Notes of the import, for example on units, are Python warnings. The result has all rows, also those
        that `usable` leaves out. Raises `BadInputError` if the import fails.

        >>> import calib
        >>> flight = calib.load_ranges(calib.sample_flight())
        >>> columns = {"initiator": "from_id", "target": "to_id", "raw_m": "range_m", "truth_m": "gt_range_m"}
        >>> frame = flight.to_pandas().rename(columns=columns)[[*columns.values(), "fpp1_dbm", "time_ns"]]
        >>> len(calib.Ranges.from_dataframe(frame))
        900
        """
        found = contents_of_frame(frame, map)
        return cls.from_exchanges(
            found.exchanges, poses=found.poses, tags=found.tags, source="data frame", temperature=found.temperature
        )

    @classmethod
    def from_differences(
        cls, table: Mapping[str, NDArray[Any]], *, poses: Poses, tags: Sequence[Tag], source: str = IN_MEMORY
    ) -> Ranges:
        """Return a row for every difference of arrival without stamps, from the columns of the table `differences`.

        A difference contains half of the difference of both anchors' delays: anchors that keep a common time measure
        their distances with the same delays, and half of a delay belongs to transmission. The anchor with the smaller
        id is the initiator. Raises `BadInputError` for an anchor without position, an anchor at both ends, and if
        `poses` show that the differences have the wrong sign or another unit.
        """
        first, second = np.minimum(table["minus"], table["plus"]), np.maximum(table["minus"], table["plus"])
        places = set(names_in(poses.body))
        unplaced = np.setdiff1d(np.append(first, second), [tag.tag for tag in tags if tag.body in places])
        if len(unplaced):
            raise BadInputError(
                f"{source}: differences of arrival contain anchor {unplaced[0]}, which has no position: give it with "
                f"`uwblink poses --tags`, or remove the anchor from the log"
            )
        if (itself := first == second).any():
            raise BadInputError(f"{source}: a difference of arrival has anchor {first[itself][0]} at both ends")
        away, across = (distances_m(poses, tags, ends, table["listener"], table["time_ns"]) for ends in (second, first))
        found = cls.from_arrays(
            np.where(table["minus"] == first, 1.0, -1.0) * table["difference_m"],
            initiator=first,
            target=second,
            truth_m=away - across,
            time_ns=table["time_ns"],
            weights=(-0.5, 0.5),
            source=source,
        )
        beyond_m = np.abs(found.raw_m) - distances_m(poses, tags, first, second, table["time_ns"])
        # Compare within pairs: with few pairs, constants of pairs may be correlated with their mean differences.
        pair, known = pairs_of(first, second).number, np.isfinite(found.raw_m) & np.isfinite(found.truth_m)
        within = (less_medians(lengths[known], pair[known]) for lengths in (found.raw_m, found.truth_m))
        fault = growth_fault("differences of arrival", *within)
        # Without poses of the listener: a difference is at most the distance of both anchors.
        if fault or np.count_nonzero(beyond_m > LARGEST_ERROR_M) > len(found) / 2:
            raise BadInputError(
                f"{source}: by its poses "
                f"{fault or 'differences of arrival are longer than the distances of their anchors'}; "
                "correct the column map of the import (the unit of difference_m in [units]; exchange from_id and "
                "to_id to change the sign)"
            )
        return replace(found, protocol=np.full(len(found), NO_STAMPS), listener=table["listener"].astype(np.int64))

    @property
    def differences(self) -> Bools:
        """Mask (n,) of rows that are differences of arrival without stamps."""
        return np.asarray(self.listener >= 0)

    @property
    def ends(self) -> Ints:
        """Initiator and target of each range (n, 2)."""
        return np.column_stack([self.initiator, self.target])

    @property
    def pairs(self) -> Pairs:
        """The pair of tags of each range, in either direction."""
        return pairs_of(self.initiator, self.target)

    @property
    def error_m(self) -> Floats:
        """Range minus true distance (n,), metres."""
        return self.raw_m - self.truth_m

    def __getitem__(self, rows: int | slice | Bools | Ints) -> Ranges:
        """Return the chosen ranges, in their order, with their arrivals."""
        found = ColumnTable.__getitem__(self, rows)
        return found if self.arrivals is None else replace(found, arrivals=self.arrivals.of_exchanges(rows, len(self)))

    def to_dict(self) -> dict[str, NDArray[Any]]:
        """Return the columns (n,) by name, without directions, temperatures, features, listeners and `valid_ns`."""
        hidden = ("toward", "temperature_c", "features", "listener", "valid_ns")
        return {name: column for name, column in self._columns().items() if name not in hidden}

    def _title(self) -> str:
        left = "".join(f", {count} left out: {reason}" for reason, count in self.excluded.items())
        return f"Ranges of {self.source}: {len(self)} of tags {', '.join(map(str, self.tags()))}{left}"

    def __repr__(self) -> str:
        """Return source, number of ranges, tags, and counts of ranges that were left out."""
        return f"<{self._title()}>"

    def _repr_html_(self) -> str:
        """Return the table, and a figure of errors over time; of ranges over time if no true distance is known."""
        from uwblink.pages.figures import notebook_image, values_over_time

        errors, name = 100 * self.error_m, "raw range minus true distance (cm)"
        values, name = (errors, name) if np.isfinite(errors).any() else (self.raw_m, "raw range (m)")
        draw = partial(values_over_time, time_ns=self.time_ns, values=values, name=name)
        return ColumnTable._repr_html_(self) + notebook_image(draw, f"{name} over time")

    def tags(self) -> list[int]:
        """Return the ids of initiators and targets, in ascending order."""
        return np.flatnonzero(np.bincount(np.append(self.initiator, self.target))).tolist()

    def usable(
        self, why_no_truth: str = "", why_no_power: str = "", *, need_power: bool = True, need_truth: bool = True
    ) -> Ranges:
        """Return the usable ranges, and count the others in `excluded`, each by its first reason.

        Unusable ranges are those of a tag with itself, those without a true distance (if `need_truth`), those without
        any power (if `need_power`), and those that are not finite or longer than 10 km. Raises `UnanswerableError` if
        none remains; the text includes `why_no_truth` or `why_no_power` if most ranges lack it.
        """
        good = {
            "a tag with itself": self.initiator != self.target,
            "no true distance": np.isfinite(self.truth_m) | (not need_truth),
            "no power": np.isfinite(self.fpp1_dbm) | np.isfinite(self.fpp2_dbm) | (not need_power),
            f"no range within {MAX_RANGE_M / 1000:.0f} km": np.abs(self.raw_m) < MAX_RANGE_M,
        }
        keep, excluded = np.ones(len(self), dtype=bool), dict[str, int]()
        for reason, rows in good.items():
            excluded[reason] = int(np.count_nonzero(keep & ~rows))
            keep &= rows
        if keep.any():
            left_out = {reason: count for reason, count in excluded.items() if count}
            return replace(self[keep], excluded=self.excluded | left_out) if left_out else self
        if not len(self):
            raise UnanswerableError(f"{self.source}: holds no exchanges")
        hints = {
            "no true distance": why_no_truth
            or "add poses and lever arms (`uwblink poses`), or measured distances (gt_range_m of a table); without "
            "true distances use `calib survey`, or `calib fit --truth ranges`",
            "no power": why_no_power or "a calibration without a curve needs no power: use `calib fit --delays-only`",
            "a tag with itself": "check from_id and to_id of the import",
        }
        most = max(excluded, key=lambda reason: excluded[reason])
        hint = f"; {hints[most]}" if most in hints else ""
        raise UnanswerableError(f"{self.source}: none of its {len(self)} exchanges can be used: {most}{hint}")


def growth_fault(what: str, raw_m: Floats, truth_m: Floats) -> str:
    """Return a text if lengths (n,) have another unit or sign than their true values (n,), else "".

    `what` names the lengths in the text.
    """
    # The slope of fewer points is too uncertain (a judgement).
    if len(raw_m) < 20:
        return ""
    slope = _robust_slope(truth_m, raw_m)
    rest = robust_spread(raw_m - slope * truth_m)
    # Other units have ratios of 0.305 (feet) or less, and 3.28 or more. If the line explains less than three times the
    # rest, the lengths do not depend on these true values, and the slope is arbitrary.
    if 0.75 < slope < 1.35 or abs(slope) * robust_spread(truth_m) < 3.0 * rest:
        return ""
    guesses = ["they have the wrong sign" if slope < 0 else "", look_like("they", abs(slope))]
    return "; ".join(filter(None, [f"{what} change by {slope:.3g} m per metre of true distance", *guesses]))


def look_like(what: str, ratio: float) -> str:
    """Return a guess of the unit of lengths from their ratio to the true ones, "" if no unit is near."""
    whose, smaller = ("true distances", ratio) if ratio < 1 else (what, 1 / ratio)
    # A foot is 0.305 m, a nanosecond of flight 0.300 m. Units differ by factors of three or more, and delays change a
    # range of metres by less than a fifth, so a ratio within 20 % (0.2 in its logarithm) identifies the unit.
    units = {0.001: "millimetres", 0.01: "centimetres", 0.3: "feet or nanoseconds"}
    near = (
        f"{whose} are probably {unit}" for own, unit in units.items() if abs(np.log(max(smaller, 1e-9) / own)) < 0.2
    )
    return next(near, "")


def _robust_slope(x: Floats, y: Floats) -> float:
    """Return the slope of y (n,) over x (n,) between the medians of the outer thirds (Tukey's resistant line)."""
    order = np.argsort(x, kind="stable")
    third = max(len(x) // 3, 1)
    low, high = order[:third], order[-third:]
    run = float(np.median(x[high]) - np.median(x[low]))
    return float(np.median(y[high]) - np.median(y[low])) / run if run > 0 else 1.0


def contents_of_frame(frame: Any, map_source: MapSource | None = None) -> Contents:
    """Import a data frame as a table; notes of the import become Python warnings. Raises `BadInputError`."""
    from uwblink.importers import read_source

    with restating(BadInputError, ImportTableError, ArgumentError):
        found = read_source(frame, map_file=map_source)
    for note in found.meta.get("notes", ()):
        warn(note)
    return found


def read_c(table: Mapping[str, NDArray[Any]], ids: Ints, time_ns: Ints) -> NDArray[np.float32]:
    """Return the temperatures of tags `ids` (n, 2) at times (n,), from the columns of a table `temperature`.

    Readings are interpolated linearly, and held before the first and after the last. More than 30 s from the nearest
    reading, the temperature is NaN: boards need a minute or more to warm up, so less than half of a change is missed.
    """
    found = np.full(ids.shape, np.nan, dtype=np.float32)
    known = np.isfinite(measured_c(table["temperature_c"]))
    for tag in np.unique(table["tag"][known]).tolist():
        when, first = np.unique(table["time_ns"][known & (table["tag"] == tag)], return_index=True)
        celsius = table["temperature_c"][known & (table["tag"] == tag)][first]
        row, end = np.nonzero(ids == tag)
        at = time_ns[row]
        after = np.searchsorted(when, at)
        away = [np.abs(when[np.clip(after - k, 0, len(when) - 1)] - at) for k in (0, 1)]
        found[row, end] = np.where(np.minimum(*away) <= 30e9, np.interp(at, when, celsius), np.nan)
    return found


def _supply_v_per_k(table: Mapping[str, NDArray[Any]]) -> tuple[tuple[int, float], ...]:
    """Return pairs of a tag and the slope of its supply voltage over temperature, in V/K, by least squares."""
    celsius, volts = measured_c(table["temperature_c"]).astype(np.float64), table["supply_v"]
    found = []
    for tag in np.unique(table["tag"]).tolist():
        some = (table["tag"] == tag) & np.isfinite(celsius) & np.isfinite(volts)
        warmer = celsius[some] - np.mean(celsius[some]) if some.any() else np.zeros(0)
        if (square := float(warmer @ warmer)) > 0:
            found.append((tag, float(warmer @ volts[some]) / square))
    return tuple(found)


def measured_c(temperature_c: Floats) -> NDArray[np.float32]:
    """Return temperatures in degrees Celsius, NaN outside the chip's storage range, -65 to 150 (DW1000 data sheet)."""
    return np.where(np.abs(temperature_c - 42.5) <= 107.5, temperature_c, np.nan).astype(np.float32)


def measured_powers(fpp_dbm: Floats) -> Floats:
    """Return first-path powers (n,) in dBm, NaN outside `FAINTEST_DBM` to `LOUDEST_DBM`."""
    with np.errstate(invalid="ignore"):
        return np.where((fpp_dbm < LOUDEST_DBM) & (fpp_dbm > FAINTEST_DBM), fpp_dbm, np.nan)


def concatenate(parts: Sequence[Ranges]) -> Ranges:
    """Join the ranges of several recordings, in their order.

    Raises `BadInputError` if a tag had different programmed antenna delays in two recordings.
    """
    session, names = _sessions(parts)
    skews = [part.uncorrected_skew for part in parts if part.uncorrected_skew]
    apart = [part.clocks_apart for part in parts if part.clocks_apart]
    bodies = {one for part in parts for one in part.bodies}
    reasons = sorted({reason for part in parts for reason in part.excluded})
    return replace(
        Ranges.concatenate(parts),
        source=", ".join(part.source for part in parts),
        excluded={reason: sum(part.excluded.get(reason, 0) for part in parts) for reason in reasons},
        uncorrected_skew=max(skews, key=lambda one: one.bound_m, default=None),
        clocks_apart=max(apart, key=lambda one: one.moves_m, default=None),
        recordings=tuple(one for part in parts for one in part.recordings),
        # If a tag was on different bodies, no tag has a known body.
        bodies=tuple(sorted(bodies)) if len({tag for tag, _ in bodies}) == len(bodies) else (),
        turning=tuple(sorted({tag for part in parts for tag in part.turning})),
        supply_v_per_k=tuple(sorted({tag: slope for part in parts for tag, slope in part.supply_v_per_k}.items())),
        session=session,
        sessions=names,
        antenna_delays=_antenna_delays_of_all(parts),
        arrivals=_arrivals_of_all(parts),
    )


def _arrivals_of_all(parts: Sequence[Ranges]) -> Arrivals | None:
    """Return the differences of arrival of all recordings, with exchanges numbered anew; None without any."""
    first = np.cumsum([0, *map(len, parts)]).tolist()
    found = [
        replace(part.arrivals, exchange=part.arrivals.exchange + start)
        for part, start in zip(parts, first, strict=False)
        if part.arrivals is not None
    ]
    return Arrivals.concatenate(found) if found else None


def _antenna_delays_of_all(parts: Sequence[Ranges]) -> AntennaDelays:
    found: dict[int, tuple[AntennaDelay, str]] = {}
    for part in parts:
        for tag, delay in known_delays(part.antenna_delays, part.tags()).items():
            if tag is None:
                continue
            known, where = found.setdefault(tag, (delay, part.source))
            if known != delay:
                raise BadInputError(
                    f"{part.source}: tag {tag} had antenna delays of {delay} ticks programmed, and {known} in {where}; "
                    "use recordings with equal antenna delays"
                )
    return {tag: delay for tag, (delay, _) in found.items()}


def of_host_clock(time_ns: int) -> bool:
    """Return whether a time counts from 1970, as host time of `uwblink record`, instead of from a start.

    Times above 20 years count from 1970.
    """
    return time_ns > 20 * 365 * 86_400 * 1_000_000_000


def _sessions(parts: Sequence[Ranges]) -> tuple[Ints, tuple[str, ...]]:
    """Return the session of each range of all recordings (n,), and the names of the sessions.

    Recordings whose host times overlap are one session.
    """
    number, names, ends = list[Ints](), list[str](), list[tuple[int, int]]()
    for part in parts:
        begin, end = (int(part.time_ns.min()), int(part.time_ns.max())) if len(part) else (0, 0)
        together = [
            k for k, (first, last) in enumerate(ends) if of_host_clock(begin) and begin <= last and first <= end
        ]
        if together and len(part.sessions) < 2:
            k = together[0]
            names[k], ends[k] = f"{names[k]}, {part.source}", (min(ends[k][0], begin), max(ends[k][1], end))
        else:
            k = len(names)
            names += part.sessions or (part.source,)
            ends += [(begin, end)] * max(len(part.sessions), 1)
        number.append(np.asarray(part.session + k, dtype=np.int32))
    return np.concatenate(number), tuple(names)


def without_static(ranges: Ranges) -> Ranges:
    """Leave out spans of 2 s in which the distance of a pair changes by at most 2 cm.

    Bodies that stand still repeat one geometry, and with it one error. Raises `UnanswerableError` if nothing moves.
    """
    span, pairs = (ranges.time_ns - ranges.time_ns.min()) // 2_000_000_000, ranges.pairs
    group = np.unique(span * len(pairs.ends) + pairs.number, return_inverse=True)[1]
    every = np.arange(group.max() + 1)
    reach = ndimage.maximum(ranges.truth_m, group, every) - ndimage.minimum(ranges.truth_m, group, every)
    moves = reach[group] > 0.02
    if not moves.any():
        raise UnanswerableError(f"{ranges.source}: nothing moves, so `trim_static` removes all ranges")
    count = int(np.count_nonzero(~moves))
    return replace(ranges[moves], excluded=ranges.excluded | ({STATIC: count} if count else {}))


def held_out(ranges: Ranges, share: float, fold: str) -> Bools:
    """Return a mask (n,) of a share of the ranges to hold out, in whole parts that are evenly spread.

    With `fold` "time" parts are tenths of each session's time, with "pair" pairs of tags, with "session" sessions.
    Raises `UnanswerableError` if nothing is left to fit, or nothing is held out.
    """
    if fold == "pair":
        unit = ranges.pairs.number
    elif fold == "session":
        unit = np.unique(ranges.session, return_inverse=True)[1]
    else:
        unit = np.empty(len(ranges), dtype=np.int64)
        for number, session in enumerate(np.unique(ranges.session).tolist()):
            mine = ranges.session == session
            since = ranges.time_ns[mine] - ranges.time_ns[mine].min()
            unit[mine] = 10 * number + np.minimum(10 * since // max(int(since.max()), 1), 9)
    found = np.floor((unit + 1) * share + 1e-9) > np.floor(unit * share + 1e-9)
    if not found.any() or found.all():
        raise UnanswerableError(
            f"{ranges.source}: {share:g} of its {int(unit.max()) + 1} parts by {fold} leaves nothing to fit or "
            f"nothing to evaluate; choose another share or fold"
        )
    return np.asarray(found)
