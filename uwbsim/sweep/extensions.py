"""What strangers added to this process, to be there in the workers of a sweep as well.

Workers are other processes, perhaps on other machines: functions reach them by module and name.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any, Final

from uwblink.protocols.rows import RangingProtocol
from uwblink.protocols.table import PROTOCOLS, register_protocol
from uwbsim.errors import ParameterError
from uwbsim.simulation.simulated import Simulated
from uwbsim.world.channel import CHANNEL_EFFECTS, OWN_EFFECTS, ChannelEffect

Evaluate = Callable[[Simulated], Mapping[str, Any]]
"""Returns the figures of a flight as columns of one row: numbers, texts or None."""

GROUP: Final = "uwbcal.evaluators"
"""Entry points of this group offer functions of kind `Evaluate`, by the name of a sweep's kind."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Extensions:
    """What a worker needs besides its tasks: the function that evaluates flights, protocols, effects of the channel."""

    evaluate: Evaluate | None = None
    protocols: tuple[RangingProtocol, ...] = ()
    effects: tuple[tuple[str, ChannelEffect], ...] = ()

    @classmethod
    def of_here(cls, evaluate: Evaluate | None, protocols: Sequence[str]) -> Extensions:
        """Return what this process has, with the rows of some protocols."""
        added = {name: effect for name, effect in CHANNEL_EFFECTS.items() if name not in OWN_EFFECTS}
        rows = tuple(PROTOCOLS[name] for name in protocols)
        return cls(evaluate=evaluate, protocols=rows, effects=tuple(added.items()))

    def install(self) -> None:
        """Have a process know what is in here; what it knows already stays."""
        for row in self.protocols:
            if row.name not in PROTOCOLS:
                register_protocol(row)
        for name, effect in self.effects:
            CHANNEL_EFFECTS.setdefault(name, effect)

    def check(self) -> None:
        """Raise `ParameterError` where another process would not find a function by its name."""
        named: dict[str, object] = {f"channel effect {name!r}": effect for name, effect in self.effects}
        for row in self.protocols:
            formulas = {part: getattr(row, part) for part in ("flight_ticks", "delay_weights")}
            named |= {f"{part} of protocol {row.name!r}": formula for part, formula in formulas.items()}
        if self.evaluate is not None:
            named["evaluate"] = self.evaluate
        for what, function in named.items():
            if not _found_by_name(function):
                raise ParameterError(
                    f"found {function!r}, which other processes cannot import; "
                    "give a function at the top of a module, or work in this process (workers = 1)",
                    parameter=what,
                )


def _found_by_name(function: object) -> bool:
    module = sys.modules.get(getattr(function, "__module__", None) or "")
    return getattr(module, getattr(function, "__qualname__", ""), None) is function


def evaluator(kind: str) -> Evaluate:
    """Return the function that installed distributions offer for a kind of sweep; raises `ParameterError`."""
    for entry in entry_points(group=GROUP, name=kind):
        try:
            found: Evaluate = entry.load()
        except (ImportError, AttributeError) as error:
            raise ParameterError(
                f"{entry.value}, which {GROUP} names, cannot be imported: {error}", parameter="evaluate"
            ) from error
        return found
    raise ParameterError(
        f"a sweep of kind {kind!r} needs a function that evaluates a flight, and no installed distribution offers one "
        f"(entry point {kind!r} of the group {GROUP})",
        parameter="evaluate",
    )
