"""Who ranges with whom, how, and how often: the ranging plan of a recording.

```toml
pairs = [[10, 20], [10, 30]]   # initiator, target; or "all"
rate_hz = 100.0                # exchanges a second in total; without it, as fast as the boards answer
protocol = "ds"                # or "ss"
target_reports = false         # have the target report each exchange too
get_cir = false                # have the initiator print its channel impulse response

[[tags]]                       # optional: where each board sits, for truth from motion capture
id = 10
body = "ifo001"
lever_arm_m = [0.17, -0.17, -0.05]

[antenna_delays.tags.10]       # optional: what was programmed into a board; without any, 16436 into all
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

from uwblink.errors import PlanError
from uwblink.recording.antenna_delays import FILE_KEYS as DELAY_KEYS
from uwblink.recording.antenna_delays import AntennaDelay, AntennaDelays, delay_of, read_antenna_delays
from uwblink.recording.schema import Tag
from uwblink.recording.tags import is_board_id, read_tags
from uwblink.text_files import FileKey, TomlReader, heads, is_number

FILE_KEYS: Final = (
    FileKey("pairs", '"all" or [[initiator, target], ...]', '"all"', "Who ranges with whom, in turns."),
    FileKey("rate_hz", "number, Hz, above 0", "as fast as the boards answer", "Exchanges a second in total."),
    FileKey("protocol", '"ds" or "ss"', '"ds"', "Double-sided or single-sided ranging."),
    FileKey("target_reports", "true or false", "false", "Whether the target reports each exchange, too."),
    FileKey(
        "get_cir", "true or false", "false", "Whether the initiator prints its channel impulse response; this is slow."
    ),
    FileKey("tags[].id", "whole number, 0 to 254", "needed", "A board whose place on a body is known."),
    FileKey("tags[].body", "text", "needed", "The body that carries it, as motion capture calls it."),
    FileKey("tags[].lever_arm_m", "3 numbers, m", "[0.0, 0.0, 0.0]", "Where its antenna sits in the body's frame."),
    *DELAY_KEYS,
)
"""The keys of a plan's file, for its reader and the reference."""


@dataclass(frozen=True, slots=True)
class RangingPlan:
    """A ranging plan: `pairs` of (initiator, target) in the order in which they take turns, "all", or () to listen.

    `rate_hz` exchanges a second in total, as fast as boards answer without it. `tags` say where boards sit, and
    `antenna_delays` what was programmed into them (under None: into those not named), 16436 into all where it is empty.
    Raises `PlanError` for what cannot be played.

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
        if self.rate_hz is not None and not (is_number(self.rate_hz) and self.rate_hz > 0):
            raise PlanError(f"rate_hz: found {self.rate_hz!r}, expected a positive number")
        if self.protocol not in ("ds", "ss"):
            raise PlanError(f"protocol: found {self.protocol!r}, allowed: ds, ss")
        for pair in () if self.pairs == "all" else self.pairs:
            if not (isinstance(pair, tuple) and len(pair) == 2 and all(map(is_board_id, pair)) and pair[0] != pair[1]):
                raise PlanError(f'pairs: found {pair!r:.60}, expected "all" or pairs of two different ids')

    def delays(self) -> AntennaDelays:
        """Return what is programmed into boards: what is said of it, else the 16436 of their firmware into all."""
        return self.antenna_delays or {None: AntennaDelay()}

    def programmed(self, present: Iterable[int]) -> AntennaDelays:
        """Return what is programmed into boards that are present; raises `PlanError` where only some are told."""
        found = {board: delay_of(self.delays(), board) for board in sorted(present)}
        unknown = [board for board, delay in found.items() if delay is None]
        if unknown:
            raise PlanError(
                f"antenna_delays: nothing is said of board {_listed(unknown)}; say what is programmed into it, or give "
                "tx, rx and reply for all that are not named"
            )
        return {board: delay for board, delay in found.items() if delay is not None}

    def turns(self, present: Sequence[int]) -> tuple[tuple[int, int], ...]:
        """Return the pairs among boards that are present, none to only listen; raises `PlanError` naming absent ones.

        "all" means every two boards once, except two on one body, whose distance says nothing.
        """
        if self.pairs == "all":
            body = {tag.tag: tag.body for tag in self.tags}
            turns = tuple(
                (a, b) for a, b in combinations(sorted(present), 2) if a not in body or body[a] != body.get(b)
            )
            if not turns:
                raise PlanError(f"no two boards to range with each other; found {_listed(present)}")
            return turns
        if not self.pairs:
            return ()
        absent = sorted({tag for pair in self.pairs for tag in pair} - set(present))
        if absent:
            raise PlanError(f"the plan names {_listed(absent)}, but the boards at the ports are {_listed(present)}")
        return self.pairs


def load_plan(path: Path) -> RangingPlan:
    """Read a plan; raises `PlanError` that names the key."""
    file = TomlReader(path, PlanError)
    table = file.table
    file.known(table, (name.removesuffix("[]") for name in heads(FILE_KEYS)))
    rate = table.get("rate_hz")
    file.check("rate_hz", rate, rate is None or (is_number(rate) and rate > 0), "a positive number")
    flags = {name: table.get(name, False) for name in ("target_reports", "get_cir")}
    protocol = file.choice("protocol", table.get("protocol", "ds"), ("ds", "ss"))
    for name, value in flags.items():
        file.check(name, value, isinstance(value, bool), "true or false")
    pairs = _pairs(path, table.get("pairs", "all"))
    return RangingPlan(
        pairs, rate_hz=rate, protocol=protocol, tags=read_tags(file), antenna_delays=read_antenna_delays(file), **flags
    )


def _pairs(path: Path, value: Any) -> tuple[tuple[int, int], ...] | Literal["all"]:
    if value == "all":
        return "all"
    good = isinstance(value, list) and value and all(isinstance(p, list) and len(p) == 2 for p in value)
    if not good or not all(is_board_id(tag) for pair in value for tag in pair):
        raise PlanError(f'{path}: pairs: found {value!r}, expected "all" or [[initiator, target], ...] of ids')
    for a, b in value:
        if a == b:
            raise PlanError(f"{path}: pairs: tag {a} cannot range with itself")
    return tuple((a, b) for a, b in value)


def _listed(tags: Iterable[int]) -> str:
    return ", ".join(map(str, tags)) or "none"
