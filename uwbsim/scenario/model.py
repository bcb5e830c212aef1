"""The scenario: the validated contents of a TOML file. Units are in the key names, and leave here as SI properties.

`uwbsim.scenario.loading.load` turns every mistake into one `ScenarioError` line. The models here and in `ranging`,
`radio`, `devices` and `bodies` are the whole schema, with descriptions of all keys.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from itertools import combinations
from operator import sub
from typing import Annotated, Any, Final, Self

from pydantic import Field, model_validator

import uwbsim
from uwblink.display import as_html
from uwblink.ticks import SPEED_OF_LIGHT
from uwbsim.scenario.base import NotNegative, Positive, Section, Vector, require
from uwbsim.scenario.bodies import Motion, Obstacle, Recorded, Room
from uwbsim.scenario.devices import Body, Devices, ScenarioTag
from uwbsim.scenario.radio import GeometricMultipath, Radio, Spline, TwoStateMultipath
from uwbsim.scenario.ranging import Ranging

WAVELENGTH_M: Final = SPEED_OF_LIGHT / 3993.6e6
"""At the centre of channel 2, which the boards use (firmware wire format, 2.2)."""


NO_BROADCASTS: Final = "ranging.plan: found 'broadcast', but the boards' firmware has no broadcasts; use `uwbsim run`"
"""Why virtual boards, and their wire format, refuse a scenario of broadcasts."""


class RunSettings(Section):
    """Name, seed and length of the simulation."""

    name: str = Field("unnamed", description="Name of the run, in recordings and on pages.")
    seed: Annotated[int, Field(ge=0)] = Field(
        0,
        description="Seed of all random numbers: the same seed gives the same bytes.",
    )
    duration_s: Positive = Field(description="Duration of the simulated flight.")


class Mocap(Section):
    """The motion capture that writes the poses of the recording."""

    rate_hz: Positive = Field(100.0, description="Poses of each body per second.")
    position_noise_m: NotNegative = Field(0.0, description="Standard deviation of each coordinate.")
    attitude_noise_rad: NotNegative = Field(0.0, description="Standard deviation of the attitude about each axis.")
    latency_ms: float = Field(0.0, description="Delay of the times of poses.")
    gaps_per_min: NotNegative = Field(0.0, description="Mean number of gaps per minute and body.")
    gap_s: Positive = Field(0.5, description="Duration of a gap.")


class Scenario(Section):
    """A whole scenario file."""

    run: RunSettings = Field(description="Name, seed and length.")
    ranging: Ranging = Field(description="Ranging: protocol, rate, pairs, plan, delays.")
    radio: Radio = Field(Radio(), description="Radios: power, noise, bias and reflections.")
    mocap: Mocap = Field(Mocap(), description="The motion capture that writes the poses.")
    devices: Devices = Field(Devices(), description="Effects of temperature and supply voltage on boards.")
    room: Room | None = Field(None, description="Room; by default none.")
    obstacles: tuple[Obstacle, ...] = Field((), description="Boxes that attenuate and delay waves.")
    min_separation_m: NotNegative = Field(
        0.0,
        description="Least distance between bodies: random flights are drawn again until they keep it.",
    )
    bodies: Annotated[tuple[Body, ...], Field(min_length=1)] = Field(
        description="Bodies that carry tags: robots, people, tripods.",
    )
    tags: Annotated[tuple[ScenarioTag, ...], Field(min_length=2)] = Field(description="The boards, two or more.")

    def _repr_html_(self) -> str:
        """Return what is simulated, a row for each tag, and the room as a figure, for a notebook."""
        motions = {body.name: body.motion.model for body in self.bodies}
        rows = [
            [str(tag.id), tag.body, motions[tag.body]]
            + [f"{x:.4g}" for x in (*tag.lever_arm_m, sub(*tag.delays_ns()), tag.skew_ppm)]
            for tag in self.tags
        ]
        from uwblink.pages.figures import notebook_image

        names = ["tag", "body", "motion", "x (m)", "y (m)", "z (m)", "delay (ns)", "skew (ppm)"]
        plan = f"{self.ranging.protocol}, {self.run.duration_s:g} s, {len(self.pairs())} pairs"
        drawn = notebook_image(partial(uwbsim.pages.figures.room, scenario=self), "paths of bodies, tags and walls")
        return as_html(f"Scenario {self.run.name!r}: {plan}", [names, *rows]) + drawn

    @model_validator(mode="after")
    def _check(self) -> Self:
        names = [body.name for body in self.bodies]
        ids = [tag.id for tag in self.tags]
        for k, name in enumerate(names):
            require(name not in names[:k], f"bodies[{k}].name: found a second {name!r}, names must differ")
        for k, tag in enumerate(self.tags):
            require(tag.id not in ids[:k], f"tags[{k}].id: found a second {tag.id}, ids must differ")
            require(tag.body in names, f"tags[{k}].body: found {tag.body!r}, the bodies are {', '.join(names)}")
        self._check_tags(ids)
        self._check_geometric()
        self._check_places()
        self._check_plan()
        fastest = self.ranging.fastest_hz(self.radio.preamble_symbols, len(self.senders()))
        broadcast, rate = self.ranging.plan == "broadcast", self.ranging.rate_hz
        why = f"frames of {len(self.senders())} tags" if broadcast else "this response_delay_uus"
        require(
            self.ranging.plan == "aloha" or rate <= fastest,
            f"ranging.rate_hz: found {rate:g}, at {why} the air allows at most {fastest:.0f}",
        )
        require(
            self.pairs(),
            "ranging.pairs: no exchange is possible, because no two tags are on different bodies, or send broadcasts",
        )
        return self

    def _check_tags(self, ids: list[int]) -> None:
        """Raise `ValueError` where pairs, or slots of a plan, name a tag that is not there."""
        named = [("ranging.pairs: found", pair) for pair in self.ranging.pairs if not isinstance(pair, str)]
        model, plan = self.radio.multipath, self.ranging.plan
        if isinstance(model, TwoStateMultipath):
            named += [(f"radio.multipath.pairs[{k}].tags: found", pair.tags) for k, pair in enumerate(model.pairs)]
        if not isinstance(plan, str):
            named += [(f"ranging.plan: slot {k + 1} names", slot[1:]) for k, slot in enumerate(plan.slots)]
        for where, pair in named:
            for tag_id in pair:
                if tag_id not in ids:
                    raise ValueError(f"{where} tag {tag_id}, the tags are {', '.join(map(str, ids))}")

    def _check_geometric(self) -> None:
        """The geometric model takes reflections from materials, and needs a room to put things into."""
        model = self.radio.multipath
        if not isinstance(model, GeometricMultipath):
            return
        if self.room and self.room.reflection_loss_db is not None:
            raise ValueError(
                f"room.reflection_loss_db: found {self.room.reflection_loss_db:g}, but in the geometric model "
                f"reflections follow from room.material; remove this key"
            )
        require(
            self.room or not model.scatterers,
            f"radio.multipath.scatterers: found {model.scatterers} but no room for them; give room, or 0",
        )

    def _check_places(self) -> None:
        """Bodies must be inside the room, and recorded for the whole run; their tags a wavelength apart or more."""
        for k, body in enumerate(self.bodies):
            if isinstance(body.motion, Recorded):
                lasts_s = max(body.motion.times_s, default=0.0)
                require(
                    lasts_s >= self.run.duration_s,
                    f"bodies[{k}].motion.file: its trajectory lasts {lasts_s:.1f} s and does not cover the run of "
                    f"{self.run.duration_s:g} s",
                )
            for key, point in _named_points(body.motion):
                if self.room and any(
                    not lo <= v <= hi for lo, v, hi in zip(self.room.min_m, point, self.room.max_m, strict=True)
                ):
                    raise ValueError(
                        f"bodies[{k}].motion.{key}: found {list(point)}, outside the room "
                        f"{list(self.room.min_m)} to {list(self.room.max_m)}"
                    )
        for a, b in combinations(range(len(self.tags)), 2):
            one, two = self.tags[a], self.tags[b]
            apart = sum((x - y) ** 2 for x, y in zip(one.lever_arm_m, two.lever_arm_m, strict=True)) ** 0.5
            if one.body == two.body and apart < WAVELENGTH_M:
                raise ValueError(
                    f"tags[{b}].lever_arm_m: tags {one.id} and {two.id} of body {one.body!r} are {100 * apart:.1f} cm "
                    f"apart, closer than a wavelength ({100 * WAVELENGTH_M:.1f} cm)"
                )

    def _check_plan(self) -> None:
        if self.ranging.plan == "broadcast":
            for key in ("protocol", "pairs", "get_cir"):
                found, only = getattr(self.ranging, key), Ranging.model_fields[key].default
                require(found == only, f"ranging.{key}: found {found!r}, but plan broadcast allows only {only!r}")
        if isinstance(self.ranging.plan, str):
            return
        for k, (time_s, initiator, target) in enumerate(self.ranging.plan.slots):
            # Without texts for the good ones: there may be a million.
            if initiator == target:
                raise ValueError(f"ranging.plan: slot {k + 1} is of tag {initiator} with itself")
            if not time_s >= 0:
                raise ValueError(f"ranging.plan: slot {k + 1} is at {time_s:g} s, before the start")
        first = min(time_s for time_s, _, _ in self.ranging.plan.slots)
        require(
            first <= self.run.duration_s,
            f"ranging.plan: its first slot is at {first:g} s, after the end of the run (run.duration_s = "
            f"{self.run.duration_s:g}); use a longer run",
        )

    def changed(self, section: str, **values: Any) -> Self:
        """Return the scenario with other values in a table such as `run`; they are not validated."""
        return self.model_copy(update={section: getattr(self, section).model_copy(update=values)})

    def pairs(self) -> list[tuple[int, int]]:
        """Return the (initiator, target) pairs in the order in which they range; of broadcasts, in either role."""
        if self.ranging.plan == "broadcast":
            return [*combinations(self.senders(), 2)]
        if self.ranging.pairs != "between-bodies":
            return list(self.ranging.pairs)
        return [(a.id, b.id) for a, b in combinations(self.tags, 2) if a.body != b.body]

    def senders(self) -> list[int]:
        """Return the ids of the tags that send: with plan broadcast, passive tags only listen."""
        return [tag.id for tag in self.tags if not tag.passive or self.ranging.plan != "broadcast"]

    def planted(self) -> dict[str, Any]:
        """Return the planted values that a calibration of this scenario should find, as JSON values."""
        delays = {str(t.id): t.delays_ns()[0] - t.delays_ns()[1] for t in self.tags}
        bias = self.radio.bias if isinstance(self.radio.bias, Spline) else None
        sigma = self.radio.sigma
        fields = {"knots", "coefficients", "degree"}
        return {
            "delays_ns": delays,
            "bias_curve": bias.model_dump(mode="json", include=fields) if bias else None,
            "sigma_curve": sigma.model_dump(mode="json", include=fields) if sigma else None,
            "alpha_dbm": -82.0,
        }


def _named_points(motion: Motion) -> Iterator[tuple[str, Vector]]:
    """Yield the points that a motion is known to reach, with their keys."""
    for key in ("position_m", "box_min_m", "box_max_m"):
        if hasattr(motion, key):
            yield key, getattr(motion, key)
    for key in ("places_m", "points_m"):
        for k, point in enumerate(getattr(motion, key, ())):
            yield f"{key}[{k}]", point
