"""The radios of a scenario: power, noise, bias, and what is between them."""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from uwbsim.scenario.base import NotNegative, Positive, Section, Share, TagId, Vector
from uwbsim.scenario.devices import GroupDelay, check_grid
from uwbsim.scenario.published_curves import BIAS, SIGMA
from uwbsim.units import MM, MS, NS, PS

MATERIALS: Final = {
    "air": (0.0, 1.0),
    "drywall": (15.0, 1.6),
    "wood": (25.0, 1.5),
    "glass": (40.0, 2.5),
    "brick": (45.0, 2.0),
    "concrete": (80.0, 2.4),
    "person": (60.0, 6.0),
    "metal": (2000.0, 1.0),
}
"""Loss in dB a metre and refractive index near 4 GHz: round values from ITU-R P.2040-3 (building materials; person as
wet tissue). Excess delay is (index - 1) times the thickness."""


class Spline(Section):
    """A B-spline over lifted first-path power 10^((fpp_dbm + 82)/10), held constant beyond its ends."""

    knots: tuple[float, ...]
    coefficients: tuple[float, ...]
    degree: Annotated[int, Field(ge=0, le=5)] = 3

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.knots) != len(self.coefficients) + self.degree + 1:
            raise ValueError(
                f"knots: found {len(self.knots)}, a spline of degree {self.degree} with "
                f"{len(self.coefficients)} coefficients has {len(self.coefficients) + self.degree + 1}"
            )
        if list(self.knots) != sorted(self.knots) or self.knots[0] == self.knots[-1]:
            raise ValueError("knots: must not decrease, and must span a range")
        return self


class SigmaSpline(Spline):
    """Standard deviation of the range in metres, where dt32/dt53 is `reply_ratio`."""

    reply_ratio: NotNegative = 0.0


class BiasTable(Section):
    """Bias in metres at received powers in dBm, linear between them and constant beyond."""

    power_dbm: tuple[float, ...]
    bias_m: tuple[float, ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.power_dbm) != len(self.bias_m) or len(self.power_dbm) < 2:
            raise ValueError(
                f"bias_m: found {len(self.bias_m)} values at {len(self.power_dbm)} powers, give two or more of each"
            )
        steps = [b - a for a, b in zip(self.power_dbm, self.power_dbm[1:], strict=False)]
        if not (all(s > 0 for s in steps) or all(s < 0 for s in steps)):
            raise ValueError("power_dbm: must go one way")
        return self


def _named(known: dict[str, dict[str, Any] | None]) -> Any:
    def look_up(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        if value not in known:
            raise ValueError(f"found {value!r}, known curves are {', '.join(known)}")
        return known[value]

    return BeforeValidator(look_up)


class IndependentMultipath(Section):
    """The positive tail, drawn for each exchange alone: with `probability` it travels an exponential excess distance.

    All pairs are alike, nothing lasts, and neither power nor impulse response tells such an exchange from others.
    """

    model: Literal["independent"] = "independent"
    probability: Share
    mean_excess_m: Positive


class PairMultipath(Section):
    """What a pair of tags has of reflections where it is known; the rest is drawn."""

    tags: tuple[TagId, TagId]
    share: Share | None = None
    life_s: Positive | None = None
    mean_excess_m: Positive | None = None


class TwoStateMultipath(Section):
    """Reflections that last: at any time a pair's first path is the direct one or a reflection.

    At random instants, on average a pair's life apart, a pair's path is drawn anew: with its share a reflection, whose
    excess length has a gamma distribution of mean `mean_excess_m` and shape `excess_shape` (1 is exponential). So both
    the state and the excess have the autocorrelation exp(-dt/life). Pairs' shares have the mean `share` and the
    standard deviation `share_std` (a beta distribution), their lives the median `life_s` and `life_spread` as the
    standard deviation of the logarithm; `pairs` has those that are known. A reflection leaves its trace: its first path
    is weaker than the direct one by `first_path_loss_db` on average (`loss_std_db` about it) and all paths together by
    `total_loss_db`, with most of the power in a path that comes `rise_ns` later on average.
    A direct path seems longer or shorter by `direct_std_m`, as long as it lasts.
    """

    model: Literal["two-state"]
    share: Share = 0.1
    share_std: NotNegative = 0.0
    life_s: Annotated[float, Field(ge=0.01)] = 0.5
    life_spread: Annotated[float, Field(ge=0, le=2)] = 0.0
    mean_excess_m: Positive = 0.4
    excess_shape: Positive = 1.0
    first_path_loss_db: NotNegative = 8.0
    loss_std_db: NotNegative = 2.0
    total_loss_db: NotNegative = 2.0
    rise_ns: Positive = 6.0
    direct_std_m: NotNegative = 0.0
    pairs: tuple[PairMultipath, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.share_std and self.share_std**2 >= self.share * (1 - self.share):
            most = (self.share * (1 - self.share)) ** 0.5
            raise ValueError(
                f"share_std: found {self.share_std:g}, with a mean of {self.share:g} it is below {most:.3g}"
            )
        if self.total_loss_db > self.first_path_loss_db:
            raise ValueError(
                f"total_loss_db: found {self.total_loss_db:g}, at most first_path_loss_db ({self.first_path_loss_db:g})"
            )
        known = [frozenset(pair.tags) for pair in self.pairs]
        for k, pair in enumerate(known):
            if len(pair) < 2 or pair in known[:k]:
                raise ValueError(
                    f"pairs[{k}].tags: found {list(self.pairs[k].tags)}, give two tags, and each pair once"
                )
        return self

    @property
    def rise_s(self) -> float:
        """Return in seconds how much later the strongest path comes on average."""
        return self.rise_ns * NS


class Fading(Section):
    """Power that comes and goes with the place, alike in both directions of a pair of tags.

    At random instants, `life_s` apart on average, it is drawn anew, with the standard deviation `std_db`; so its
    autocorrelation is exp(-dt/life). With `levels_db` it has these quantiles instead, from 0 to 1 in equal steps.
    """

    std_db: NotNegative = 0.0
    levels_db: tuple[float, ...] = ()
    life_s: Annotated[float, Field(ge=0.01)] = 0.5

    @model_validator(mode="after")
    def _check(self) -> Self:
        if len(self.levels_db) == 1 or list(self.levels_db) != sorted(self.levels_db):
            raise ValueError("levels_db: give two or more, which do not decrease")
        if self.levels_db and self.std_db:
            raise ValueError("levels_db: give either levels_db or std_db")
        return self


class Outages(Section):
    """Whiles in which two tags do not hear each other, for no reason that the scenario has: `share` of the time.

    At random instants, `life_s` apart on average, it is drawn anew whether a pair is out.
    """

    share: Share
    life_s: Annotated[float, Field(ge=0.01)] = 0.5


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
    responses (median 7.5 dB); these also say 18 dB for `radio.dynamic_range_db`, and 12 for `threshold_to_noise`.
    """

    model: Literal["geometric"]
    scatterers: Annotated[int, Field(ge=0, le=500)] = 32
    scatter_loss_db: float = 1.0
    decay_ns: Positive = 12.0
    step_ms: Annotated[float, Field(ge=0.1, le=100)] = 5.0
    stamp_noise: bool = True
    threshold_to_noise: Positive = 12.0

    @property
    def decay_s(self) -> float:
        """Return over which time the power of what bounces around falls to a share of 1/e."""
        return self.decay_ns * NS

    @property
    def step_s(self) -> float:
        """Return in seconds how often responses are computed."""
        return self.step_ms * MS


def _independent_unless_named(value: Any) -> Any:
    return {"model": "independent"} | value if isinstance(value, dict) else value


Multipath = Annotated[
    Annotated[IndependentMultipath | TwoStateMultipath | GeometricMultipath, Field(discriminator="model")],
    BeforeValidator(_independent_unless_named),
]


class AntennaTable(Section):
    """Gain in dB over azimuth and elevation in the body's frame: a full grid, interpolated linearly."""

    azimuth_deg: tuple[float, ...]
    elevation_deg: tuple[float, ...]
    gain_db: tuple[tuple[float, ...], ...]

    @model_validator(mode="after")
    def _check(self) -> Self:
        check_grid(self.azimuth_deg, self.elevation_deg, "gain_db", self.gain_db)
        return self


class Radio(Section):
    """Power, noise and bias of every radio; the defaults are those of measured boards.

    Sources (firmware wire format, section 5): `rx_noise_ps` and `skew_noise_ppm`, `skew_bias_ppm` from 1833 exchanges
    of MILUV; `sensitivity_dbm` a little below the weakest first path seen there (-104.2 dBm); frame settings those of
    the firmware. `capture_db` and `dynamic_range_db` are typical of the chip's correlator, and not measured here.

    First-path powers that boards read, and what goes by them, saturate at `saturation_dbm`: the chip's readings fall
    behind above -85 dBm (DW1000 User Manual, 4.7.2), and those of the ICRA 2023 flights end at -80.

    A board reads `carrier_sign` times the rate of its clock less that of the sender's, plus `skew_bias_ppm`, which
    grows by `skew_bias_ppm_per_db` above -90 dBm of first-path power: 1 is the boards' convention, -1 that of firmwares
    which print by how much the sender is ahead. `group_delay` is that of the antennas of all tags that have none of
    their own.
    """

    first_path_at_1m_dbm: float = -80.0
    path_loss_exponent: NotNegative = 2.0
    antenna: Literal["isotropic", "dipole"] | AntennaTable = "isotropic"
    shadowing_db: NotNegative = 0.0
    power_noise_db: NotNegative = 0.0
    saturation_dbm: float | None = None
    sensitivity_dbm: float = -105.0
    tx_noise_ps: NotNegative = 0.0
    rx_noise_ps: NotNegative = 116.0
    skew_noise_ppm: NotNegative = 0.20
    skew_bias_ppm: float = -0.13
    skew_bias_ppm_per_db: float = 0.0
    carrier_sign: Literal[-1, 1] = 1
    group_delay: GroupDelay | None = None
    quantize: bool = True
    preamble_symbols: Literal[64, 128, 256, 512, 1024, 1536, 2048, 4096] = 128
    capture_db: NotNegative = 6.0
    dynamic_range_db: Positive = 15.0
    bias: Annotated[Spline | BiasTable | None, _named(BIAS)] = None
    sigma: Annotated[SigmaSpline | None, _named(SIGMA)] = None
    multipath: Multipath | None = None
    fading: Fading | None = None
    outages: Outages | None = None

    @property
    def independent_multipath(self) -> tuple[float, float]:
        """Return probability and mean in metres of detours that are drawn for each exchange alone; zeros for none."""
        if isinstance(self.multipath, IndependentMultipath):
            return self.multipath.probability, self.multipath.mean_excess_m
        return 0.0, 0.0

    @property
    def tx_noise_s(self) -> float:
        """Return the standard deviation of transmissions about their stamps, in seconds."""
        return self.tx_noise_ps * PS

    @property
    def rx_noise_s(self) -> float:
        """Return the standard deviation of receive stamps that does not depend on power, in seconds."""
        return self.rx_noise_ps * PS


class Material(Section):
    """What an obstacle is made of: loss in dB a metre, and refractive index."""

    loss_db_per_m: NotNegative
    index: Annotated[float, Field(ge=1)] = 1.0


def _known(material: Any) -> Any:
    if isinstance(material, str) and material not in MATERIALS:
        raise ValueError(f"found {material!r}, known are {', '.join(MATERIALS)}")
    return material


KnownMaterial = Annotated[str | Material, AfterValidator(_known)]


class Obstacle(Section):
    """A box that waves go through, at a loss and late. `material` is a name or a table of its own.

    In the geometric model its faces reflect; `roughness_mm` is the standard deviation of their heights.
    """

    name: str = "obstacle"
    min_m: Vector
    max_m: Vector
    material: KnownMaterial
    roughness_mm: NotNegative = 3.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(lo >= hi for lo, hi in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("min_m: must be below max_m in every direction")
        return self

    def properties(self) -> tuple[float, float]:
        """Return loss in dB a metre, and refractive index."""
        return properties(self.material)

    @property
    def roughness_m(self) -> float:
        """Return the standard deviation of its surface's heights in metres."""
        return self.roughness_mm * MM


def properties(material: str | Material) -> tuple[float, float]:
    """Return loss in dB a metre and refractive index of a material, by its name or as given."""
    if isinstance(material, str):
        return MATERIALS[material]
    return material.loss_db_per_m, material.index


class Room(Section):
    """The room: a box, whose six surfaces reflect with `reflection_loss_db` where it is given.

    In the geometric model they reflect as their `material` does, or `floor` and `ceiling` where these are given;
    `roughness_mm` is the standard deviation of their heights.
    """

    min_m: Vector
    max_m: Vector
    reflection_loss_db: NotNegative | None = None
    material: KnownMaterial = "concrete"
    floor: KnownMaterial | None = None
    ceiling: KnownMaterial | None = None
    roughness_mm: NotNegative = 3.0

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(lo >= hi for lo, hi in zip(self.min_m, self.max_m, strict=True)):
            raise ValueError("min_m: must be below max_m in every direction")
        return self

    @property
    def roughness_m(self) -> float:
        """Return the standard deviation of its surfaces' heights in metres."""
        return self.roughness_mm * MM

    def materials(self) -> tuple[str | Material, ...]:
        """Return those of the six surfaces: two walls across x, two across y, floor and ceiling."""
        return (*[self.material] * 4, self.floor or self.material, self.ceiling or self.material)


class Shadow(Section):
    """The part of a body that waves do not pass unharmed: an ellipsoid in the body's frame."""

    semi_axes_m: tuple[Positive, Positive, Positive]
    centre_m: Vector = (0.0, 0.0, 0.0)
    loss_db_per_m: NotNegative = 40.0
