"""The command that tells the whole story: report."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from calib.cli.arguments import (
    AsJson,
    Fix,
    Force,
    GroupFile,
    Lift,
    Loss,
    MinimumNorm,
    Recordings,
    Scale,
    Sequential,
    TrimStatic,
)
from calib.cli.flags import with_flags

if TYPE_CHECKING:
    from calib.calibration.model import Calibration
    from calib.cli.options import FitOptions
    from calib.evaluation.localization import Localization
    from calib.ranges import Ranges

MANY: Final = "--tests"
SCALES: Final = (0.25, 0.5, 0.71, 1.0, 1.41, 2.0, 4.0)


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    app.command()(report)


def spread(arguments: Sequence[str]) -> list[str]:
    """Let `--tests` take several files: repeat it before every word up to the next option."""
    found: list[str] = []
    inside = False
    for word in arguments:
        if word.startswith("-"):
            inside = word == MANY
            if not inside:
                found.append(word)
        else:
            found += [MANY, word] if inside else [word]
    return found


def report(
    recordings: Recordings,
    output: Annotated[Path, typer.Option("-o", "--output", help="Report to write (.html).")],
    tests: Annotated[list[Path] | None, typer.Option(help="Recordings to judge the calibration by (.uwb).")] = None,
    pdf: Annotated[Path | None, typer.Option(help="Report to write as PDF, too.")] = None,
    figures: Annotated[Path | None, typer.Option(help="Folder for the figures as PDF and SVG, at paper size.")] = None,
    loss: Loss = "cauchy",
    scale: Scale = "auto",
    lift: Lift = "mean-of-lifted",
    fix: Fix = None,
    group: GroupFile = None,
    sequential: Sequential = False,
    trim_static: TrimStatic = False,
    minimum_norm: MinimumNorm = False,
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit, judge and localize, and write it all as one page."""
    from rich.console import Console

    from calib.cli.options import check_folder, fit_options, load_each
    from calib.doctor.examine import examine
    from calib.estimation.fitting import fit
    from calib.ranges import concatenate
    from calib.report.report import Campaign, to_dict, write_campaign
    from uwblink.recording.file import check_output

    options = fit_options(loss, scale, lift, fix, group, sequential=sequential, minimum_norm=minimum_norm)
    for path in filter(None, (output, pdf)):
        check_output(path, force=force)
    check_folder("figures", figures)
    judged = tests or []
    with Console(file=sys.stderr).status("loading") as status:
        training, testing = load_each(recordings, trim_static=trim_static), load_each(judged)
        status.update("fitting")
        found = fit(concatenate(training), **options)
        refits = _refits(concatenate(training), found.calibration, options)
        status.update("examining")
        findings = [(path.name, finding) for path in (*recordings, *judged) for finding in examine(path)]
        status.update("localizing")
        campaign = Campaign(
            training,
            testing,
            found,
            refits,
            _heard(recordings, found.calibration),
            findings,
            _tracks(judged or recordings, found.calibration),
        )
        write_campaign(campaign, output, pdf, figures, force=force, progress=status.update)
    if as_json:
        typer.echo(json.dumps(to_dict(campaign), indent=1))
        return
    for path in filter(None, (output, pdf, figures)):
        typer.echo(f"report: {path}")
    for warning in [*found.warnings, *(f"{name}: {finding.fault}" for name, finding in findings)]:
        typer.echo(f"warning: {with_flags(warning)}", err=True)


def _refits(ranges: Ranges, calibration: Calibration, options: FitOptions) -> dict[float, Calibration]:
    """Fit again with other scales of the loss; the mixture and least squares have none."""
    from calib.estimation.fitting import fit
    from calib.estimation.losses import MIXTURE

    if calibration.loss in (MIXTURE, "l2"):
        return {}
    found = {}
    for factor in SCALES:
        changed = options.copy()
        changed["scale_ns"] = factor * calibration.scale_ns
        found[factor * calibration.scale_ns] = fit(ranges, **changed).calibration
    return found


def _heard(recordings: list[Path], calibration: Calibration) -> dict[int, Any]:
    """Delays by passive listeners, from the first recording that has them."""
    from calib.estimation.passive_listeners import heard_delays

    return next(filter(None, (heard_delays(path, calibration) for path in recordings)), {})


def _tracks(recordings: list[Path], calibration: Calibration) -> list[Localization]:
    """Localize in every recording that has a body to localize; a report does without those that have none."""
    from calib.errors import UnanswerableError
    from calib.evaluation.localization import localize
    from calib.ranges import load_flight

    found: list[Localization] = []
    for path in recordings:
        try:
            found += localize(load_flight(path), calibration)
        except UnanswerableError:
            continue
    return found
