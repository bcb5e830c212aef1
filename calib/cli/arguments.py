"""Arguments and options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

import typer

from uwblink.cli.guide import choice, tags_of
from uwblink.cli.options import AsJson as AsJson
from uwblink.cli.options import CalibrationFile as CalibrationFile
from uwblink.cli.options import Figures as Figures
from uwblink.cli.options import Force as Force
from uwblink.cli.options import output

Recordings = Annotated[list[Path], typer.Argument(help="Recordings with true distances (.uwb).")]
NewCalibration = Annotated[Path, output("Calibration to write (.json).")]
WEIGHTS: Final = "How errors count"
MODEL: Final = "What is fitted"
UNKNOWN: Final = "Without known distances (--truth ranges)"
OWN_LOSSES: Final = ("mixture", "cauchy", "huber", "soft_l1", "l2")


def _losses() -> list[str]:
    from calib.estimation import known_losses

    return list(known_losses())


Loss = Annotated[
    str | None,
    typer.Option(
        rich_help_panel=WEIGHTS,
        help="mixture (the default): a likelihood with reflections by pair; cauchy: that of --sequential, and of less "
        "than 15 ranges a pair; l2: least squares; or a registered one.",
        **choice(*OWN_LOSSES, more=_losses),
    ),
]
ReferencePower = Annotated[
    float | None,
    typer.Option(
        rich_help_panel=MODEL,
        help="Power in dBm at which the curve is zero, and the delays are stated (default: -82, the published alpha).",
    ),
]
Scale = Annotated[
    str,
    typer.Option(
        metavar="NS|auto",
        rich_help_panel=WEIGHTS,
        help="Error in ns of flight beyond which the loss discounts a range, or auto: from the data.",
    ),
]
Lift = Annotated[
    str,
    typer.Option(
        rich_help_panel=MODEL,
        help="Power of an exchange from those of its two ends.",
        **choice("mean-of-lifted", "lift-of-mean"),
    ),
]
Fix = Annotated[
    list[str] | None,
    typer.Option(
        metavar="TAG=NS",
        rich_help_panel=MODEL,
        autocompletion=tags_of("{}="),
        help="Delay of a tag that is known and stays as it is, as in 1=-0.36; may be repeated.",
    ),
]
GroupFile = Annotated[
    Path | None,
    typer.Option(
        rich_help_panel=MODEL,
        help="Groups of tags that share curves (.toml with a table \\[groups]); by default all tags do.",
    ),
]
DelaysOnly = Annotated[
    bool,
    typer.Option(
        "--delays-only",
        rich_help_panel=MODEL,
        help="Fit no curve: for ranges without power, or whose power follows distance.",
    ),
]
DelaysFrom = Annotated[
    Path | None,
    typer.Option(
        rich_help_panel=MODEL,
        help="Calibration whose delays are taken over (.json); with those of all tags the curve is left.",
    ),
]
Constants = Annotated[
    str,
    typer.Option(
        rich_help_panel=MODEL,
        help="What a constant error belongs to: tags (antenna delays), or pairs (each its own constant).",
        **choice("tag", "pair"),
    ),
]
Sequential = Annotated[
    bool,
    typer.Option(
        "--sequential",
        rich_help_panel=MODEL,
        help="Fit the delays first and then the curve to what they leave, as in ICRA 2023.",
    ),
]
TrimStatic = Annotated[
    bool,
    typer.Option(
        "--trim-static",
        rich_help_panel=WEIGHTS,
        help="Leave out spans of 2 s in which a pair's distance stays within 2 cm.",
    ),
]
MinimumNorm = Annotated[
    bool,
    typer.Option(
        "--minimum-norm",
        rich_help_panel=MODEL,
        help="Where the pairs leave delays free, fit the smallest ones that agree with the data.",
    ),
]
Truth = Annotated[
    str,
    typer.Option(
        rich_help_panel=UNKNOWN,
        help="recorded: from poses or a tape; ranges: not known, found together with the delays.",
        **choice("recorded", "ranges"),
    ),
]
PosesUntil = Annotated[
    float | None,
    typer.Option(
        metavar="SECONDS", rich_help_panel=UNKNOWN, help="How long positions of poses count (all along by default)."
    ),
]
Attitudes = Annotated[
    str | None,
    typer.Option(
        rich_help_panel=UNKNOWN,
        help="Where attitudes come from: poses (the default), all along, or imu.",
        **choice("poses", "imu", "none"),
    ),
]
HeadingStd = Annotated[
    float | None,
    typer.Option(
        metavar="DEGREES", rich_help_panel=UNKNOWN, help="What headings may be off by (3 by default; 0: nothing)."
    ),
]
Anchors = Annotated[
    str | None,
    typer.Option(
        rich_help_panel=UNKNOWN,
        help="Places of bodies that stand still: given by the poses (the default), or sought.",
        **choice("given", "sought"),
    ),
]
Distances = Annotated[
    list[str] | None,
    typer.Option(
        "--distance",
        metavar="TAG-TAG=METRES",
        rich_help_panel=UNKNOWN,
        help="Distance of two antennas by a tape, as in 11-12=3.06, good to 1 cm or as said, 3.06+-0.005; of tags that "
        "move, while they stood still: 1-3=1.52@2..8 (seconds, or the name of an arrangement). May be repeated.",
    ),
]
Heights = Annotated[
    str | None,
    typer.Option(
        rich_help_panel=UNKNOWN,
        help="Readings of height sensors in the recording: used (the default) or ignored.",
        **choice("used", "ignored"),
    ),
]
CurveFrom = Annotated[
    Path | None,
    typer.Option(
        rich_help_panel=UNKNOWN,
        help="Calibration whose curve over power is taken as it is (.json): for flights short of ranges or powers.",
    ),
]
