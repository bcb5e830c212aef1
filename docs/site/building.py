"""What `make docs` does before Sphinx reads the pages: writes what is generated, for the pages to include."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from calib.calibration.document import CALIBRATION_KEYS as CALIBRATION
from calib.cli.commands import app as calib_app
from docs.site import checks, commands, doors, file_keys, schema
from uwblink.boards.ranging_plan import PLAN_KEYS as PLAN
from uwblink.cli.commands import app as uwblink_app
from uwblink.importers.column_map import MAP_KEYS as COLUMN_MAP
from uwbsim.boards.server import FaultsFile
from uwbsim.cli.commands import app as uwbsim_app
from uwbsim.scenario.model import Scenario
from uwbsim.sweep.design import SweepFile

GENERATED: Final = Path(__file__).parents[1] / "generated"

PAGES: Final[dict[str, Callable[[], str]]] = {
    "scenario": lambda: schema.reference(Scenario.model_json_schema(), "Scenario"),
    "faults": lambda: schema.reference(FaultsFile.model_json_schema(), "FaultsFile"),
    "column_map": lambda: file_keys.reference(COLUMN_MAP),
    "plan": lambda: file_keys.reference(PLAN),
    "sweep": lambda: schema.reference(SweepFile.model_json_schema(), "SweepFile"),
    "calibration": lambda: file_keys.reference(CALIBRATION),
    "checks": checks.reference,
    "warnings": checks.warnings,
    "uwbsim": lambda: commands.reference(uwbsim_app, "uwbsim"),
    "uwblink": lambda: commands.reference(uwblink_app, "uwblink"),
    "calib": lambda: commands.reference(calib_app, "calib"),
    "api_uwbsim": lambda: doors.reference("uwbsim"),
    "api_uwblink": lambda: doors.reference("uwblink"),
    "api_calib": lambda: doors.reference("calib"),
}


def write_pages(_app: Any = None) -> None:
    """Write all generated pages; one that would not change is left alone, so that it is not read again."""
    GENERATED.mkdir(exist_ok=True)
    for name, make in PAGES.items():
        path, text = GENERATED / f"{name}.md", make() + "\n"
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def connect(app: Any) -> dict[str, bool]:
    """Have Sphinx write the generated pages before it looks for pages, and show aliases by their names."""
    app.connect("builder-inited", write_pages)
    app.connect("autodoc-process-signature", doors.plain_aliases)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
