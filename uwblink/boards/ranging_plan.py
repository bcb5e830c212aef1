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
```
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Final, Literal

from uwblink.errors import PlanError
from uwblink.recording.schema import Tag

PROTOCOLS: Final = ("ds", "ss")
KEYS: Final = ("pairs", "rate_hz", "protocol", "target_reports", "get_cir", "tags")
LARGEST_ID: Final = 254


@dataclass(frozen=True, slots=True)
class RangingPlan:
    """A ranging plan: `pairs` of (initiator, target) in the order in which they take turns."""

    pairs: tuple[tuple[int, int], ...] | Literal["all"] = "all"
    rate_hz: float | None = None
    protocol: str = "ds"
    target_reports: bool = False
    get_cir: bool = False
    tags: tuple[Tag, ...] = ()

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
    table = _table(path)
    for key in table:
        if key not in KEYS:
            raise PlanError(f"{path}: {key}: unknown key; known are {', '.join(KEYS)}")
    rate = table.get("rate_hz")
    if rate is not None and not (_is_number(rate) and rate > 0):
        raise PlanError(f"{path}: rate_hz: found {rate!r}, expected a positive number")
    protocol = table.get("protocol", "ds")
    if protocol not in PROTOCOLS:
        raise PlanError(f"{path}: protocol: found {protocol!r}, allowed: {', '.join(PROTOCOLS)}")
    flags = {name: table.get(name, False) for name in ("target_reports", "get_cir")}
    for name, value in flags.items():
        if not isinstance(value, bool):
            raise PlanError(f"{path}: {name}: found {value!r}, expected true or false")
    pairs, tags = _pairs(path, table.get("pairs", "all")), read_tags(path, table.get("tags", []))
    return RangingPlan(pairs, rate, protocol, tags=tags, **flags)


def load_tags(path: Path) -> tuple[Tag, ...]:
    """Read the `[[tags]]` of a plan or a scenario; raises `PlanError`."""
    tags = read_tags(path, _table(path).get("tags", []))
    if not tags:
        raise PlanError(f"{path}: holds no [[tags]] with id, body and lever_arm_m")
    return tags


def read_tags(path: Path, rows: Any) -> tuple[Tag, ...]:
    """Return tags from the rows of a TOML array of tables; raises `PlanError`."""
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise PlanError(f"{path}: tags: expected [[tags]] tables with id, body and lever_arm_m")
    tags: list[Tag] = []
    for k, row in enumerate(rows):
        number, body = row.get("id"), row.get("body")
        arm = row.get("lever_arm_m", [0.0, 0.0, 0.0])
        if not _is_id(number):
            raise PlanError(f"{path}: tags[{k}].id: found {number!r}, expected a whole number 0 to {LARGEST_ID}")
        if any(tag.tag == number for tag in tags):
            raise PlanError(f"{path}: tags[{k}].id: found a second {number}, ids must differ")
        if not isinstance(body, str) or not body:
            raise PlanError(f"{path}: tags[{k}].body: found {body!r}, expected the name of a body")
        if not isinstance(arm, list) or len(arm) != 3 or not all(map(_is_number, arm)):
            raise PlanError(f"{path}: tags[{k}].lever_arm_m: found {arm!r}, expected three numbers (metres)")
        tags.append(Tag(number, body, (float(arm[0]), float(arm[1]), float(arm[2]))))
    return tuple(tags)


def _table(path: Path) -> dict[str, Any]:
    if path.is_dir():
        raise PlanError(f"{path}: is a directory, expected a file (.toml)")
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError as error:
        raise PlanError(f"{path}: no such file") from error
    except (OSError, UnicodeDecodeError) as error:
        raise PlanError(f"{path}: cannot be read as text") from error
    except tomllib.TOMLDecodeError as error:
        raise PlanError(f"{path}: not valid TOML: {error}") from error


def _pairs(path: Path, value: Any) -> tuple[tuple[int, int], ...] | Literal["all"]:
    if value == "all":
        return "all"
    good = isinstance(value, list) and value and all(isinstance(p, list) and len(p) == 2 for p in value)
    if not good or not all(_is_id(tag) for pair in value for tag in pair):
        raise PlanError(f'{path}: pairs: found {value!r}, expected "all" or [[initiator, target], ...] of ids')
    for a, b in value:
        if a == b:
            raise PlanError(f"{path}: pairs: tag {a} cannot range with itself")
    return tuple((a, b) for a, b in value)


def _is_id(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= LARGEST_ID


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _listed(tags: Iterable[int]) -> str:
    return ", ".join(map(str, tags)) or "none"
