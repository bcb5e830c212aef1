"""The radios of a scenario: power, noise, bias curves, reflections, fading and outages."""

from __future__ import annotations

from functools import partial
from itertools import pairwise
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, model_validator

from uwblink.arrays import Bools, Floats, Ints
from uwbsim.scenario.base import NotDecreasing, NotNegative, Positive, Section, Share, TagId, look_up, require
from uwbsim.scenario.devices import DirectionTable, GroupDelay

# Knots of the splines published with the paper (campaigns 2022-08 and 2022-07, decargroup/uwb_calibration).
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


SIGMA: Final[dict[str, dict[str, Any] | None]] = {
    "none": None,
    "icra2023": {
        "knots": _AUGUST,
        "coefficients": [0.07418352595325353, 0.11438036048184572, 0.04769635492702895, 0.06499148440853658],
        "reply_ratio": 0.2,
    },
    "icra2023-july": {
        "knots": _JULY,
        "coefficients": [0.20866472194861246, 0.08108610512201572, 0.06722711440695964, 0.07144904233331333],
        "reply_ratio": 0.2,
    },
    "miluv": {
        "knots": [0.01] * 5 + [1.8] * 5,
        "coefficients": [
            0.18973127701786333, 0.1401417272865022, 0.3951126347143982, -0.11438027911679073, 0.12874371852672592,
        ],
        "degree": 4,
        "reply_ratio": 0.2,
    },
}  # fmt: skip
"""Standard deviation of a double-sided range in metres, as those were from which the curves come.

The boards of these flights had dt32/dt53 of 305 us to 1539 us.
"""


class IndependentMultipath(Section):
    """The positive tail, drawn for each exchange alone: with `probability` it travels an exponential excess distance.

    All pairs are alike, nothing lasts, and neither power nor impulse response differs from that of other exchanges.
    """

    model: Literal["independent"] = Field("independent", description="Drawn for each exchange alone.")
    probability: Share = Field(description="Share of exchanges whose first path is a detour.")
    mean_excess_m: Positive = Field(description="Mean excess length of detours, which is exponential.")


class PairMultipath(Section):
    """Known properties of the reflections of a pair of tags; the others are drawn."""

    tags: tuple[TagId, TagId] = Field(description="The two tags.")
    share: Share | None = Field(None, description="Share of time in which their first path is a reflection.")
    life_s: Positive | None = Field(None, description="Mean time between redraws of their path.")
    mean_excess_m: Positive | None = Field(None, description="Mean excess length of their reflections.")


class TwoStateMultipath(Section):
    """Reflections that last: at any time a pair's first path is the direct one or a reflection.

    At random instants, on average a pair's life apart, a pair's path is drawn anew: with its share a reflection, whose
    excess length has a gamma distribution. So both the state and the excess have the autocorrelation exp(-dt/life). A
    reflection leaves its trace in the powers, and in the impulse response most of its power comes late.
    """

    model: Literal["two-state"] = Field(description="Reflections that last, by pair.")
    share: Share = Field(0.1, description="Mean share of time in which a pair's first path is a reflection.")
    share_std: NotNegative = Field(0.0, description="Standard deviation of pairs' shares (a beta distribution).")
    life_s: Annotated[float, Field(ge=0.01)] = Field(0.5, description="Median time between redraws of a pair's path.")
    life_spread: Annotated[float, Field(ge=0, le=2)] = Field(
        0.0,
        description="Standard deviation of the logarithm of pairs' lives.",
    )
    mean_excess_m: Positive = Field(0.4, description="Mean excess length of reflections.")
    excess_shape: Positive = Field(
        1.0,
        description="Shape of the gamma distribution of excess lengths; 1 is exponential.",
    )
    first_path_loss_db: NotNegative = Field(
        8.0,
        description="Mean loss of a reflected first path relative to the direct one.",
    )
    loss_std_db: NotNegative = Field(2.0, description="Standard deviation of first_path_loss_db.")
    total_loss_db: NotNegative = Field(2.0, description="Loss of the total power while the first path is a reflection.")
    rise_ns: Positive = Field(6.0, description="Mean delay of the strongest path after a reflected first path.")
    direct_std_m: NotNegative = Field(
        0.0,
        description="Standard deviation of an error of the length of direct paths, constant between redraws.",
    )
    pairs: tuple[PairMultipath, ...] = Field((), description="Known properties of single pairs; the others are drawn.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.share_std and self.share_std**2 >= self.share * (1 - self.share):
            most = (self.share * (1 - self.share)) ** 0.5
            raise ValueError(
                f"share_std: found {self.share_std:g}, with a mean of {self.share:g} it is below {most:.3g}"
            )
        require(
            self.total_loss_db <= self.first_path_loss_db,
            f"total_loss_db: found {self.total_loss_db:g}, at most first_path_loss_db ({self.first_path_loss_db:g})",
        )
        known = [frozenset(pair.tags) for pair in self.pairs]
        for k, pair in enumerate(known):
            require(
                len(pair) == 2 and pair not in known[:k],
                f"pairs[{k}].tags: found {list(self.pairs[k].tags)}, give two tags, and each pair once",
            )
        return self


class Fading(Section):
    """Fading: a random change of received power, the same in both directions of a pair of tags.

    At random instants, `life_s` apart on average, it is drawn anew, with the standard deviation `std_db`; so its
    autocorrelation is exp(-dt/life). With `levels_db` it has these quantiles instead, from 0 to 1 in equal steps.
    """

    std_db: NotNegative = Field(0.0, description="Standard deviation of the power; or give levels_db.")
    levels_db: NotDecreasing = Field(
        (),
        description="Quantiles of the power from 0 to 1 in equal steps, two or more; or give std_db.",
    )
    life_s: Annotated[float, Field(ge=0.01)] = Field(0.5, description="Mean time between redraws.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        require(len(self.levels_db) != 1, "levels_db: found one, give two or more")
        require(not (self.levels_db and self.std_db), "levels_db: give either levels_db or std_db")
        return self

    def draw_db(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw changes of power in dB, (1, count)."""
        if not self.levels_db:
            return self.std_db * rng.standard_normal((1, count))
        return np.interp(rng.random((1, count)), np.linspace(0, 1, len(self.levels_db)), self.levels_db)


class Outages(Section):
    """Intervals in which two tags do not hear each other, without another cause in the scenario: `share` of the time.

    At random instants, `life_s` apart on average, it is drawn anew whether a pair is out.
    """

    share: Share = Field(description="Share of time in which two tags do not hear each other.")
    life_s: Annotated[float, Field(ge=0.01)] = Field(0.5, description="Mean time between redraws.")

    def draw_db(self, rng: np.random.Generator, count: int) -> Floats:
        """Draw changes of power in dB, (1, count)."""
        return np.where(rng.random((1, count)) < self.share, -80.0, 0.0)  # below any sensitivity


class GeometricMultipath(Section):
    """One impulse response from geometry: direct path, reflections off room and obstacles, and things in the room.

    The room's surfaces and the obstacles' faces reflect as their materials do (Fresnel), less what their roughness
    scatters; obstacles and bodies throw shadows with soft edges. `scatterers` are things at places of their own in the
    room, drawn from the seed: each gives back what a mirror there would, less `scatter_loss_db` on average (with a
    Rayleigh distribution of its field), later by what waves bounce around it, whose power dies out over `decay_ns`.
    All paths add up with their phases. The response is computed for each pair every `step_ms`; of it follow first path,
    powers, excess range, impulse response, and with `stamp_noise` what noise does to the leading edge: noise is
    `threshold_to_noise` times below the first path's threshold, which is `radio.dynamic_range_db` below the strongest
    tap, or at `radio.sensitivity_dbm`.

    `scatter_loss_db` and `decay_ns` were chosen so that rooms have the total less first-path powers of MILUV's recorded
    responses (median 7.5 dB); they also suggest 18 dB for `radio.dynamic_range_db`, and 12 for `threshold_to_noise`.
    """

    model: Literal["geometric"] = Field(description="One impulse response from geometry.")
    scatterers: Annotated[int, Field(ge=0, le=500)] = Field(
        32,
        description="Number of scatterers in the room, at places drawn from the seed.",
    )
    scatter_loss_db: float = Field(
        1.0,
        description="Mean loss of a scatterer relative to a mirror in its place.",
    )
    decay_ns: Positive = Field(12.0, description="Time constant in which the power scattered by one decays by e.")
    step_ms: Annotated[float, Field(ge=0.1, le=100)] = Field(
        5.0,
        description="Interval at which the response of each pair is computed.",
    )
    stamp_noise: bool = Field(
        True, description="Whether the noise of stamps is computed from the slope of the leading edge."
    )
    threshold_to_noise: Positive = Field(
        12.0,
        description="Ratio of the first path's threshold to the noise.",
    )


def _independent_unless_named(value: Any) -> Any:
    return {"model": "independent"} | value if isinstance(value, dict) else value


Multipath = Annotated[
    Annotated[IndependentMultipath | TwoStateMultipath | GeometricMultipath, Field(discriminator="model")],
    BeforeValidator(_independent_unless_named),
]


class Spline(Section):
    """A B-spline over lifted first-path power 10^((fpp_dbm + 82)/10), held constant beyond its ends."""

    knots: NotDecreasing = Field(description="Knots over lifted power, not decreasing.")
    coefficients: tuple[float, ...] = Field(
        description="Coefficients in metres, as many as knots less degree less one.",
    )
    degree: Annotated[int, Field(ge=0, le=5)] = Field(3, description="Degree of the pieces.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        require(
            len(self.knots) == len(self.coefficients) + self.degree + 1,
            f"knots: found {len(self.knots)}, a spline of degree {self.degree} with "
            f"{len(self.coefficients)} coefficients has {len(self.coefficients) + self.degree + 1}",
        )
        require(self.knots[0] != self.knots[-1], "knots: must span a range")
        return self


class SigmaSpline(Spline):
    """Standard deviation of the range in metres, where dt32/dt53 is `reply_ratio`."""

    reply_ratio: NotNegative = Field(
        0.0,
        description="At which dt32/dt53 the curve was measured: the noise of a double-sided range depends on it.",
    )


class BiasTable(Section):
    """Bias in metres at received powers in dBm, linear between them and constant beyond."""

    power_dbm: tuple[float, ...] = Field(description="Received powers, all rising or all falling.")
    bias_m: tuple[float, ...] = Field(description="Bias at each of them.")

    @model_validator(mode="after")
    def _check(self) -> Self:
        require(
            len(self.power_dbm) == len(self.bias_m) > 1,
            f"bias_m: found {len(self.bias_m)} values at {len(self.power_dbm)} powers, give two or more of each",
        )
        rises = {b > a for a, b in pairwise(self.power_dbm)}
        require(len(rises) == 1 and len(set(self.power_dbm)) == len(self.power_dbm), "power_dbm: must go one way")
        return self


class AntennaTable(DirectionTable):
    """Gain in dB over azimuth and elevation in the body's frame: a full grid, interpolated linearly."""

    quantity = "gain_db"

    gain_db: tuple[tuple[float, ...], ...] = Field(
        description="A row for each azimuth, a gain in it for each elevation.",
    )


class Radio(Section):
    """Power, noise and bias of every radio; the defaults are those of measured boards.

    Sources (firmware wire format, section 5): `rx_noise_ps` and `skew_noise_ppm`, `skew_bias_ppm` from 1833 exchanges
    of MILUV; `sensitivity_dbm` a little below the weakest first path seen there (-104.2 dBm); frame settings those of
    the firmware. `capture_db` and `dynamic_range_db` are typical of the chip's correlator, and not measured here.
    """

    first_path_at_1m_dbm: float = Field(-80.0, description="First-path power at a metre.")
    path_loss_exponent: NotNegative = Field(
        2.0,
        description="Exponent of the path loss over distance; 2 in free space.",
    )
    antenna: Literal["isotropic", "dipole"] | AntennaTable = Field(
        "isotropic",
        description="Gain of all antennas over direction in the frame of the body.",
    )
    shadowing_db: NotNegative = Field(
        0.0,
        description="Standard deviation of a random gain of each tag that varies smoothly with azimuth.",
    )
    power_noise_db: NotNegative = Field(0.0, description="Standard deviation of the noise of each power reading.")
    saturation_dbm: float | None = Field(
        None,
        description="Power at which readings of first-path power saturate; by default they do not. The chip's deviate "
        "above -85, and those of the ICRA 2023 flights end at -80.",
    )
    sensitivity_dbm: float = Field(-105.0, description="First-path power below which no frame is received.")
    tx_noise_ps: NotNegative = Field(0.0, description="Standard deviation of transmit stamps.")
    rx_noise_ps: NotNegative = Field(
        116.0,
        description="Standard deviation of receive stamps, the same at all powers.",
    )
    skew_noise_ppm: NotNegative = Field(0.20, description="Standard deviation of the carrier integrator's reading.")
    skew_bias_ppm: float = Field(-0.13, description="Bias of the carrier integrator's reading at -90 dBm and below.")
    skew_bias_ppm_per_db: float = Field(
        0.0,
        description="Change of skew_bias_ppm per dB of first-path power above -90 dBm.",
    )
    carrier_sign: Literal[-1, 1] = Field(
        1,
        description="1 if boards print how much faster their clock is than the sender's; -1 if how much slower.",
    )
    group_delay: GroupDelay | None = Field(
        None,
        description="Group delay of the antennas of all tags that have none of their own.",
    )
    quantize: bool = Field(True, description="Whether stamps are whole ticks, as on boards.")
    preamble_symbols: Literal[64, 128, 256, 512, 1024, 1536, 2048, 4096] = Field(
        128,
        description="Length of the preamble in symbols.",
    )
    capture_db: NotNegative = Field(
        6.0,
        description="Least ratio of a frame's power to that of an overlapping frame at which it is received.",
    )
    dynamic_range_db: Positive = Field(
        15.0,
        description="Largest ratio of the strongest path to a first path that is still detected.",
    )
    bias: Annotated[Spline | BiasTable | None, BeforeValidator(partial(look_up, BIAS))] = Field(
        None,
        description="Bias of ranges over power: a spline over lifted power, a table over dBm, or the name of a "
        "published curve.",
    )
    sigma: Annotated[SigmaSpline | None, BeforeValidator(partial(look_up, SIGMA))] = Field(
        None,
        description="Standard deviation of ranges over lifted power: a spline, or the name of a published curve.",
    )
    multipath: Multipath | None = Field(None, description="Reflections; by default none.")
    fading: Fading | None = Field(
        None,
        description="Fading; by default none.",
    )
    outages: Outages | None = Field(
        None,
        description="Intervals in which pairs do not hear each other; by default none.",
    )

    def loses(
        self, signal_dbm: float | Floats, start: int | Ints, other_dbm: float | Floats, other_start: int | Ints
    ) -> Bools:
        """Return whether a frame is lost that overlaps another one, from powers at the receiver and times of start.

        It is received only if it is the first and stronger by `capture_db`; weak frames disturb no other.
        """
        weaker = np.less(signal_dbm, other_dbm + self.capture_db)
        return np.asarray(np.greater_equal(other_dbm, self.sensitivity_dbm) & (weaker | np.greater(start, other_start)))

    @property
    def independent_multipath(self) -> tuple[float, float]:
        """Return probability and mean in metres of detours that are drawn for each exchange alone; zeros for none."""
        if isinstance(self.multipath, IndependentMultipath):
            return self.multipath.probability, self.multipath.mean_excess_m
        return 0.0, 0.0
