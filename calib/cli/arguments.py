"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Recordings = Annotated[list[Path], typer.Argument(help="Recordings with true distances (.uwb).")]
CalibrationFile = Annotated[Path, typer.Option("-c", "--calibration", help="Calibration (.json).")]
NewCalibration = Annotated[Path, typer.Option("-o", "--output", help="Calibration to write (.json).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print all figures as JSON, in SI units and ns.")]
Force = Annotated[bool, typer.Option(help="Replace files that are there already.")]
Loss = Annotated[
    str | None,
    typer.Option(
        help="mixture (the default: a likelihood with reflections by pair), cauchy (that of --sequential, and of less "
        "than 15 ranges a pair), huber, soft_l1, l2 (least squares) or a registered one."
    ),
]
ReferencePower = Annotated[
    float | None,
    typer.Option(
        help="Power in dBm at which the curve is zero, and the delays are stated (default: -82, the published alpha)."
    ),
]
Scale = Annotated[
    str, typer.Option(help="Error in ns of flight beyond which the loss discounts a range, or auto: from the data.")
]
Lift = Annotated[
    str, typer.Option(help="Power of an exchange from those of its two ends: mean-of-lifted or lift-of-mean.")
]
Fix = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TAG=NS", help="Delay of a tag that is known and stays as it is, as in 1=-0.36; may be repeated."
    ),
]
GroupFile = Annotated[
    Path | None,
    typer.Option(help="Groups of tags that share curves (.toml with a table \\[groups]); by default all tags do."),
]
DelaysOnly = Annotated[
    bool,
    typer.Option("--delays-only", help="Fit no curve: for ranges without power, or whose power follows distance."),
]
DelaysFrom = Annotated[
    Path | None,
    typer.Option(help="Calibration whose delays are taken over (.json); with those of all tags the curve is left."),
]
Constants = Annotated[
    str, typer.Option(help="What a constant error belongs to: tag (antenna delays) or pair (each its own constant).")
]
Sequential = Annotated[
    bool,
    typer.Option("--sequential", help="Fit the delays first and then the curve to what they leave, as in ICRA 2023."),
]
TrimStatic = Annotated[
    bool, typer.Option("--trim-static", help="Leave out spans of 2 s in which a pair's distance stays within 2 cm.")
]
MinimumNorm = Annotated[
    bool,
    typer.Option(
        "--minimum-norm", help="Where the pairs leave delays free, fit the smallest ones that agree with the data."
    ),
]
