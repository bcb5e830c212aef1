"""Every scenario in the tree runs for a few seconds, and its recording opens."""

import pytest

from tests import processes
from uwblink import load

FOLDER = processes.ROOT / "scenarios"
SCENARIOS = {path.relative_to(FOLDER).as_posix(): path for path in sorted(FOLDER.rglob("*.toml"))}


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenario_runs(name, tmp_path):
    output = tmp_path / "out.uwb"
    # Thirty hours with an exchange every twenty seconds have none in the first three seconds.
    seconds = 300 if name.startswith("wrap/") else 3
    processes.succeed("uwbsim", "run", SCENARIOS[name], "-o", output, "--set", f"run.duration_s={seconds}")
    flown = load(output)
    assert all((len(flown.exchanges), len(flown.poses), flown.tags))
