"""Options that mean the same in several commands, commands whose flags show no type, and answers to old names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from uwblink.errors import ArgumentError

Force = Annotated[bool, typer.Option("--force", help="Replace existing output.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON (SI units; delays in ns).")]
CalibrationFile = Annotated[Path, typer.Option("-c", "--calibration", help="Calibration file (.json).")]
OptionalCalibration = Annotated[Path | None, typer.Option("-c", "--calibration", help="Calibration file (.json).")]
AntennaDelays = Annotated[
    Path | None,
    typer.Option(help="Antenna delays programmed into the boards (.toml, as calib export writes them)."),
]
Duration = Annotated[float | None, typer.Option(min=0.001, help="Duration in seconds.")]
Rate = Annotated[float | None, typer.Option(min=0.001, help="Exchanges per second, all pairs together (Hz).")]
PlanFile = Annotated[Path | None, typer.Option("--plan", help="Ranging plan: which pairs range, and how (.toml).")]
PlaybackSpeed = Annotated[
    float, typer.Option("--speed", min=0.001, help="Playback speed as a factor; inf: as fast as possible.")
]
LinkDir = Annotated[Path | None, typer.Option(help="Folder for links with stable names to the pseudo-terminals.")]
Seed = Annotated[int | None, typer.Option(min=0, help="Seed of the random numbers.")]
Seeds = Annotated[int | None, typer.Option(min=1, help="Number of simulated runs, each with another seed.")]
Figures = Annotated[
    Path | None, typer.Option("--figures", help="Folder for the figures (.pdf and .svg, one and two columns wide).")
]
ReportFile = Annotated[Path | None, typer.Option("--report", help="Report to write (.html or .pdf).")]
Plot = Annotated[Path | None, typer.Option("--plot", help="Picture to write (.png, .svg or .pdf).")]


def output(sentence: str) -> Any:
    """Return the option of what a command writes, as in `Annotated[Path, output("Recording to write (.uwb).")]`."""
    return typer.Option("-o", "--output", help=sentence)


def count(sentence: str, *, min: int = 1, max: int | None = None) -> Any:  # noqa: A002 - as in typer
    """Return the option of how many things a command makes, as in `Annotated[int, count("Number of exchanges.")]`."""
    return typer.Option("-n", "--count", help=sentence, min=min, max=max)


def refuse_old_names(words: Sequence[str], renamed: Mapping[str, str]) -> None:
    """Raise `ArgumentError` that names the new option where an old one is given."""
    for word in words:
        old = word.partition("=")[0]
        if old in renamed:
            raise ArgumentError(f"{old} is now {renamed[old]}")


class Command(TyperCommand):
    """A command that shows no type for flags, and answers to the old names of its options."""

    renamed: Mapping[str, str] = {}

    def get_params(self, ctx: Any) -> Any:
        """Return the parameters; flags take no value, so none is shown."""
        return _without_type(super().get_params(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse what was typed; raises `ArgumentError` for an old name."""
        if not ctx.resilient_parsing:
            refuse_old_names(args, self.renamed)
        return super().parse_args(ctx, args)


class Group(TyperGroup):
    """A group of commands that shows no type for flags; `moved` answers what no command has the name of."""

    moved = ""

    def get_params(self, ctx: Any) -> Any:
        """Return the parameters; flags take no value, so none is shown."""
        return _without_type(super().get_params(ctx))

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse what was typed; raises `ArgumentError` where the group was a command once and is called as that."""
        if self.moved and not ctx.resilient_parsing and args and args[0] not in (*self.list_commands(ctx), "--help"):
            raise ArgumentError(self.moved)
        return super().parse_args(ctx, args)


def _without_type(parameters: Any) -> Any:
    for one in parameters:
        if getattr(one, "is_flag", False):
            one.metavar = ""
    return parameters
