"""The command that tells the whole story: report."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from calib.cli.arguments import (
    AsJson,
    Constants,
    DelaysFrom,
    DelaysOnly,
    Figures,
    Fix,
    Force,
    GroupFile,
    Lift,
    Loss,
    MinimumNorm,
    Recordings,
    ReferencePower,
    Scale,
    Sequential,
    TrimStatic,
)
from calib.cli.evaluating import PANEL, command_line, tell_seen
from calib.cli.flags import with_flags
from calib.cli.loading import STOPPED
from uwblink.cli.guide import add
from uwblink.cli.starting import keep_imported

MANY: Final = "--tests"


def add_to(app: typer.Typer) -> None:
    """Register the command."""
    add(
        app,
        report,
        "calib report train.uwb --tests test1.uwb test2.uwb -o report.html",
        "calib report train.uwb -o report.html --pdf report.pdf --figures figures",
        panel=PANEL,
    )


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
    output: Annotated[Path, typer.Option("-o", "--output", help="Report to write, one page (.html) or pages (.pdf).")],
    tests: Annotated[
        list[Path] | None,
        typer.Option(help="Recordings to judge the calibration by, which the fit does not see (.uwb)."),
    ] = None,
    pdf: Annotated[Path | None, typer.Option(help="The same report to write as PDF.")] = None,
    figures: Figures = None,
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
    as_json: AsJson = False,
    force: Force = False,
) -> None:
    """Fit, judge on other recordings, localize, and write the whole campaign as one page with tables and figures."""
    from rich.console import Console

    import calib
    from calib.cli.options import fit_options
    from calib.report import check_places

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
    check_places(output, pdf, figures, force=force)
    keep_imported()
    with Console(file=sys.stderr).status("loading") as status:
        campaign = calib.run_campaign(
            recordings,
            tests or [],
            trim_static=trim_static,
            progress=status.update,
            command=command_line(),
            **options,
        )
        campaign.write(output, pdf, figures, force=force, progress=status.update)
    if as_json:
        typer.echo(json.dumps(campaign.to_dict(), indent=1))
    else:
        for path in filter(None, (output, pdf, figures)):
            typer.echo(f"report: {path}")
        if tests:  # without any, the report itself says that the training was judged
            tell_seen(campaign.evaluation)
        findings = [f"{name}: {finding.fault}" for name, finding in campaign.findings]
        for warning in [*campaign.fit.warnings, *findings]:
            typer.echo(f"warning: {with_flags(warning)}", err=True)
    if not campaign.fit.success:
        raise typer.Exit(STOPPED)
