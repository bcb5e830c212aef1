"""What a fit looks for: delays or constants of pairs, a curve over power or none."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

CONSTANTS: Final = ("tag", "pair")
"""What a constant part of range errors may belong to: antenna delays of tags, or pairs of them."""


@dataclass(frozen=True, slots=True)
class Unknowns:
    """What is looked for: a `curve` over power or none, and what `constants` belong to.

    `constant_power` says that there was one power only, so that there is no curve to look for.
    """

    curve: bool = True
    constants: str = "tag"
    constant_power: bool = False

    @property
    def of_pairs(self) -> bool:
        """Whether each pair has a constant of its own, instead of each tag a delay."""
        return self.constants == "pair"

    def told(self, count: int) -> str:
        """Return in words what is looked for, with so many constants."""
        whose = "constants of pairs" if self.of_pairs else "delays"
        if not self.curve:
            return whose if self.of_pairs else "delays only"
        return f"{whose} and curve" if count else "curve only"

    def at_powers(self, *, varied: bool) -> Unknowns:
        """Return what can be looked for, where powers are `varied` or one."""
        return self if varied else replace(self, curve=False, constant_power=True)
