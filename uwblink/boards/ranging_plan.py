"""The ranging plan of a recording: which pairs range, how, and how often.

```toml
pairs = [[10, 20], [10, 30]]   # initiator, target; or "all"
rate_hz = 100.0                # exchanges a second in total; without it, as fast as the boards answer
protocol = "ds"                # or "ss"
target_reports = false         # have the target report each exchange too
get_cir = false                # have the initiator print its channel impulse response

[[tags]]                       # optional: places of boards, for true distances by motion capture
id = 10
body = "ifo001"
lever_arm_m = [0.17, -0.17, -0.05]

[antenna_delays.tags.10]       # optional: programmed antenna delays of a board; by default 16436 for all
tx = 16446
rx = 16449
reply = 16446
```
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import KW_ONLY, dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any, Final, Literal

from uwblink.errors import PlanError, restating
from uwblink.protocols.table import ON_BOARDS
from uwblink.recording.antenna_delays import (
    ANTENNA_DELAY_KEYS,
    AntennaDelay,
    AntennaDelays,
    known_delays,
    read_antenna_delays,
)
from uwblink.recording.schema import LARGEST_BOARD_ID, Tag, is_id, read_tags
from uwblink.text_files import FileKey, TomlReader, heads, is_number

PLAN_KEYS: Final = (
    FileKey("pairs", '"all" or [[initiator, target], ...]', '"all"', "The pairs that range, in turns."),
    FileKey("rate_hz", "number, Hz, above 0", "as fast as the boards answer", "Exchanges a second in total."),
    FileKey("protocol", '"ds" or "ss"', '"ds"', "Double-sided or single-sided ranging."),
    FileKey("target_reports", "true or false", "false", "Whether the target reports each exchange, too."),
    FileKey(
        "get_cir", "true or false", "false", "Whether the initiator prints its channel impulse response; this is slow."
    ),
    FileKey("tags[].id", "whole number, 0 to 65535", "needed", "A board with a known place on a body."),
    FileKey("tags[].body", "text", "needed", "Its body, by the name of motion capture."),
    FileKey("tags[].lever_arm_m", "3 numbers, m", "[0.0, 0.0, 0.0]", "Position of its antenna in the body's frame."),
    *ANTENNA_DELAY_KEYS,
)
"""The keys of a plan's file, for its reader and the reference."""


@dataclass(frozen=True, slots=True)
class RangingPlan:
    """A ranging plan: `pairs` of (initiator, target) in the order of their turns, "all", or () to listen.

    `rate_hz` is the number of exchanges per second in total, by default as fast as the boards answer. `tags` are places
    of boards, and `antenna_delays` the programmed delays (under None: of boards not named), by default 16436 ticks for
    all. Raises `PlanError` for a plan that cannot be executed.

    >>> import uwblink
    >>> uwblink.RangingPlan().turns([10, 20, 30])
    ((10, 20), (10, 30), (20, 30))
    >>> uwblink.RangingPlan(pairs=((20, 10),), rate_hz=50.0).turns([10, 20, 30])
    ((20, 10),)
    """

    pairs: tuple[tuple[int, int], ...] | Literal["all"] = "all"
    _: KW_ONLY
    rate_hz: float | None = None
    protocol: str = "ds"
    target_reports: bool = False
    get_cir: bool = False
    tags: tuple[Tag, ...] = ()
    antenna_delays: AntennaDelays = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Check what was given."""
        pairs, rate_hz = self.pairs, self.rate_hz
        for name, good, expected in (
            ("pairs", pairs == "all" or all(map(_is_pair, pairs)), '"all" or pairs of two different ids'),
            ("rate_hz", rate_hz is None or (is_number(rate_hz) and rate_hz > 0), "a positive number"),
            ("protocol", self.protocol in ON_BOARDS, " or ".join(ON_BOARDS)),
            ("target_reports", isinstance(self.target_reports, bool), "true or false"),
            ("get_cir", isinstance(self.get_cir, bool), "true or false"),
        ):
            if not good:
                raise PlanError(f"{name}: found {getattr(self, name)!r:.60}, expected {expected}")

    def delays(self) -> AntennaDelays:
        """Return the programmed antenna delays; by default the 16436 ticks of the firmware for all boards."""
        return self.antenna_delays or {None: AntennaDelay()}

    def programmed(self, present: Iterable[int]) -> AntennaDelays:
        """Return the programmed delays of boards that are present; raises `PlanError` if only some are given."""
        found = known_delays(self.delays(), sorted(present))
        if unknown := sorted({*present} - found.keys()):
            raise PlanError(
                f"antenna_delays: none are given for board {_listed(unknown)}; give its programmed delays, or tx, rx "
                f"and reply for all other boards"
            )
        return found

    def turns(self, present: Sequence[int]) -> tuple[tuple[int, int], ...]:
        """Return the pairs to range, none to only listen; raises `PlanError` with the names of absent boards.

        "all" means each pair of boards once, except pairs on one body, which have a fixed distance.
        """
        if self.pairs == "all":
            body = {tag.tag: tag.body for tag in self.tags}
            turns = tuple(
                (a, b) for a, b in combinations(sorted(present), 2) if a not in body or body[a] != body.get(b)
            )
            if not turns:
                raise PlanError(f"a plan needs two boards that range with each other; found {_listed(present)}")
            return turns
        if not self.pairs:
            return ()
        absent = sorted({tag for pair in self.pairs for tag in pair} - set(present))
        if absent:
            raise PlanError(f"the plan contains {_listed(absent)}, but the boards at the ports are {_listed(present)}")
        return self.pairs


def load_plan(path: Path) -> RangingPlan:
    """Read a plan; raises `PlanError` that names the key."""
    file = TomlReader(path, PlanError)
    table = file.table
    file.known(table, (name.removesuffix("[]") for name in heads(PLAN_KEYS)))
    given = {name: value for name, value in table.items() if name not in ("tags", "antenna_delays")}
    pairs = table.get("pairs", "all")
    listed = isinstance(pairs, list) and pairs and all(isinstance(pair, list) for pair in pairs)
    file.check("pairs", pairs, pairs == "all" or bool(listed), '"all" or [[initiator, target], ...] of ids')
    given["pairs"] = tuple(map(tuple, pairs)) if listed else "all"
    tags, delays = read_tags(file), read_antenna_delays(file)
    with restating(PlanError, PlanError, where=f"{path}: "):
        return RangingPlan(**given, tags=tags, antenna_delays=delays)


def _is_pair(pair: Any) -> bool:
    is_pair = isinstance(pair, tuple) and len(pair) == 2 and pair[0] != pair[1]
    return is_pair and all(is_id(one, LARGEST_BOARD_ID) for one in pair)


def _listed(tags: Iterable[int]) -> str:
    return ", ".join(map(str, tags)) or "none"
