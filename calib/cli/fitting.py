"""Commands that make calibrations: fit, add-tag."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from calib.cli.arguments import (
    Anchors,
    AsJson,
    Attitudes,
    CalibrationFile,
    Constants,
    CurveFrom,
    DelaysFrom,
    DelaysOnly,
    Distances,
    Fix,
    Force,
    GroupFile,
    HeadingStd,
    Heights,
    Lift,
    Loss,
    MinimumNorm,
    NewCalibration,
    PosesUntil,
    Recordings,
    ReferencePower,
    Scale,
    Sequential,
    TrimStatic,
    Truth,
)
from calib.cli.flags import with_flags
from calib.cli.loading import STOPPED, known_calibration
from uwblink.cli.guide import add, tags_of
from uwblink.cli.waiting import waiting

if TYPE_CHECKING:
    import calib


PANEL: Final = "Calibrate"


def add_to(app: typer.Typer) -> None:
    """Register the commands."""
    add(
        app,
        fit,
        "calib fit flight.uwb -o calibration.json",
        "calib fit monday.uwb tuesday.uwb -o both.json --fix 1=-0.36",
        "calib fit ranges.uwb -o delays.json --delays-only",
        "calib fit flight.uwb -o found.json --truth ranges --poses-until 10",
        panel=PANEL,
    )
    add(app, add_tag, "calib add-tag new.uwb -c calibration.json --tag 7 -o seven.json", panel=PANEL, name="add-tag")


def fit(
    recordings: Recordings,
    output: NewCalibration,
    loss: Loss = None,
    scale: Scale = "auto",
    lift: Lift = "mean-of-lifted",
    fix: Fix = None,
    group: GroupFile = None,
    sequential: Sequential = False,
    trim_static: TrimStatic = False,
    minimum_norm: MinimumNorm = False,
    reference_power: ReferencePower = None,
    delays_only: DelaysOnly = False,
    delays_from: DelaysFrom = None,
    constants: Constants = "tag",
    truth: Truth = "recorded",
    poses_until: PosesUntil = None,
    attitudes: Attitudes = None,
    heading_std: HeadingStd = None,
    anchors: Anchors = None,
    distance: Distances = None,
    heights: Heights = None,
    curve_from: CurveFrom = None,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit the tags' antenna delays (ns) and the curves of bias and standard deviation over first-path power (m)."""
    import calib
    from calib.cli.from_ranges import fitted_from_ranges, trajectory_options
    from calib.cli.options import fit_options
    from uwblink.output import check_output

    options = fit_options(
        loss,
        scale,
        lift,
        fix,
        group,
        sequential=sequential,
        minimum_norm=minimum_norm,
        reference_power_dbm=reference_power,
        delays_only=delays_only,
        delays_from=delays_from,
        constants=constants,
    )
    unknown = trajectory_options(
        truth,
        {
            "poses_until_s": poses_until,
            "attitudes": attitudes,
            "heading_std_deg": heading_std,
            "anchors": anchors,
            "distances": distance,
            "heights": heights,
            "curve_from": curve_from,
        },
    )
    check_output(output, force=force)
    try:
        if unknown is None:
            with waiting("fitting"):
                ranges = calib.load_ranges(recordings, trim_static=trim_static, need_power=not delays_only)
                result = calib.fit(ranges, **options)
        else:
            result = fitted_from_ranges(recordings, options, unknown, trim_static=trim_static)
    except calib.UnanswerableError as error:
        if as_json:
            typer.echo(json.dumps({"error": with_flags(str(error)), "undetermined": error.undetermined}, indent=1))
        raise
    result.save(output, force=force)
    if as_json:
        typer.echo(result.calibration.to_json(), nl=False)
    else:
        _tell(output, result)
    if not result.success:
        raise typer.Exit(STOPPED)


def _tell(output: Path, result: calib.FitResult) -> None:
    """Print what was found, and on standard error what is to be doubted."""
    found = result.calibration
    typer.echo(f"{output}: {len(result.ranges)} exchanges, {result.message}, scale {found.scale_ns:.3f} ns")
    for line in delay_lines(found):
        typer.echo(line)
    for reason, count in result.ranges.excluded.items():
        typer.echo(f"  left out: {count} exchanges, {reason}")
    for warning in result.warnings:
        typer.echo(f"warning: {with_flags(warning)}", err=True)


def delay_lines(found: calib.Calibration) -> Iterator[str]:
    """Yield a line a pair that has a constant and a line a tag: the constant or delay, and its 95 % interval."""
    from calib.spread import TWO_SIDED_95

    for pair, offset in sorted(found.pair_offsets.items()):
        half = 196 * offset.std_m
        yield f"  pair {pair[0]:3d} {pair[1]:3d}  ranges {100 * offset.offset_m:+.2f} cm too long  ± {half:.2f} (95 %)"
    if found.pair_offsets and not any(found.delays_ns.values()):
        return
    for tag, delay in sorted(found.delays_ns.items()):
        half = TWO_SIDED_95 * found.delays_std_ns.get(tag, math.nan)
        if math.isnan(half):
            yield f"  tag {tag:3d}  delay {delay:+.4f} ns  standard error not stated"
        elif math.isinf(half):
            yield f"  tag {tag:3d}  delay {delay:+.4f} ns  undetermined"
        else:
            pinned = "  pinned" if half == 0 else f"  ± {half:.4f} (95 %)"
            yield f"  tag {tag:3d}  delay {delay:+.4f} ns{pinned}"


def add_tag(
    recording: Annotated[Path, typer.Argument(help="Recording of the new tag with calibrated ones (.uwb).")],
    calibration: CalibrationFile,
    tag: Annotated[int, typer.Option(help="Id of the tag to add.", autocompletion=tags_of())],
    output: NewCalibration,
    force: Force = False,
) -> None:
    """Fit the delay of one more tag from its ranges with calibrated ones, and leave everything else as it is."""
    import calib
    from calib.spread import TWO_SIDED_95
    from uwblink.output import check_output

    check_output(output, force=force)
    with waiting("fitting"):
        found = calib.add_tag(recording, known_calibration(calibration), tag)
    found.save(output, force=force)
    half = TWO_SIDED_95 * found.delays_std_ns[tag]
    typer.echo(f"{output}: tag {tag}  delay {found.delays_ns[tag]:+.4f} ns  ± {half:.4f} (95 %)")
