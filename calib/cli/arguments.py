"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Recordings = Annotated[list[Path], typer.Argument(help="Recordings (.uwb).")]
CalibrationFile = Annotated[Path, typer.Option("-c", "--calibration", help="Calibration (.json).")]
NewCalibration = Annotated[Path, typer.Option("-o", "--output", help="Calibration to write (.json).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON.")]
Force = Annotated[bool, typer.Option(help="Replace the output if it exists.")]
Loss = Annotated[str, typer.Option(help="cauchy, huber, soft_l1, l2 or mixture.")]
Scale = Annotated[str, typer.Option(help="Scale of the loss in ns, or auto.")]
Lift = Annotated[str, typer.Option(help="mean-of-lifted or lift-of-mean.")]
Fix = Annotated[list[str] | None, typer.Option(metavar="TAG=NS", help="Pin a tag's known delay.")]
GroupFile = Annotated[Path | None, typer.Option(help="Groups of tags that share a curve (.toml).")]
Sequential = Annotated[bool, typer.Option("--sequential", help="Delays first, then the curve (the paper's recipe).")]
TrimStatic = Annotated[bool, typer.Option("--trim-static", help="Leave out seconds in which a pair stands still.")]
MinimumNorm = Annotated[
    bool, typer.Option("--minimum-norm", help="Fit the smallest delays where the pairs leave some free.")
]
