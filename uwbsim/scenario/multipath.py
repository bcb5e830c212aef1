"""What reflections, fading and outages of a scenario are made of."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from uwbsim.scenario.base import NotNegative, Positive, Section, Share, TagId
from uwbsim.units import MS, NS


class IndependentMultipath(Section):
    """The positive tail, drawn for each exchange alone: with `probability` it travels an exponential excess distance.

    All pairs are alike, nothing lasts, and neither power nor impulse response tells such an exchange from others.
    """

    model: Literal["independent"] = Field("independent", description="Drawn for each exchange alone.")
    probability: Share = Field(description="Share of exchanges that travel a detour.")
    mean_excess_m: Positive = Field(description="Mean excess length of detours, which is exponential.")


class PairMultipath(Section):
    """What a pair of tags has of reflections where it is known; the rest is drawn."""

    tags: tuple[TagId, TagId] = Field(description="The two tags.")
    share: Share | None = Field(None, description="Their share of time in reflections.")
    life_s: Positive | None = Field(None, description="Their time between redraws.")
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
        description="How much weaker a reflected first path is than the direct one, on average.",
    )
    loss_std_db: NotNegative = Field(2.0, description="Standard deviation of that.")
    total_loss_db: NotNegative = Field(2.0, description="How much weaker all paths together are then.")
    rise_ns: Positive = Field(6.0, description="How much later most of the power comes then, on average.")
    direct_std_m: NotNegative = Field(
        0.0,
        description="Standard deviation of by how much a direct path seems longer or shorter, for as long as it lasts.",
    )
    pairs: tuple[PairMultipath, ...] = Field((), description="What is known of single pairs; the rest is drawn.")

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

    std_db: NotNegative = Field(0.0, description="Standard deviation of the power; or give levels_db.")
    levels_db: tuple[float, ...] = Field(
        (),
        description="Quantiles of the power from 0 to 1 in equal steps; or give std_db.",
    )
    life_s: Annotated[float, Field(ge=0.01)] = Field(0.5, description="Mean time between redraws.")

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

    share: Share = Field(description="Share of time in which two tags do not hear each other.")
    life_s: Annotated[float, Field(ge=0.01)] = Field(0.5, description="Mean time between redraws.")


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

    model: Literal["geometric"] = Field(description="One impulse response from geometry.")
    scatterers: Annotated[int, Field(ge=0, le=500)] = Field(
        32,
        description="How many things stand in the room at places drawn from the seed.",
    )
    scatter_loss_db: float = Field(
        1.0,
        description="How much less than a mirror in its place each gives back, on average.",
    )
    decay_ns: Positive = Field(12.0, description="Over which time the power of what bounces around it dies out by e.")
    step_ms: Annotated[float, Field(ge=0.1, le=100)] = Field(
        5.0,
        description="How often the response of each pair is computed.",
    )
    stamp_noise: bool = Field(True, description="Whether the noise of stamps follows from the leading edge.")
    threshold_to_noise: Positive = Field(
        12.0,
        description="How many times below the first path's threshold the noise is.",
    )

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
