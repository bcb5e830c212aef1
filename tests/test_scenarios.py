"""Every scenario in the tree runs, at a few seconds' length, and its recording opens."""

import pytest

from tests import processes
from uwblink.recording.file import Recording

FOLDER = processes.ROOT / "scenarios"
SCENARIOS = {path.relative_to(FOLDER).as_posix(): path for path in sorted(FOLDER.rglob("*.toml"))}


@pytest.mark.parametrize("name", SCENARIOS)
def test_scenario_runs(name, tmp_path):
    output = tmp_path / "out.uwb"
    # Thirty hours of an exchange every twenty seconds have none in the first three seconds.
    seconds = 300 if name.startswith("wrap/") else 3
    processes.succeed("uwbsim", "run", SCENARIOS[name], "-o", output, "--set", f"run.duration_s={seconds}")
    with Recording.open(output) as recording:
        assert len(recording.exchanges()) > 0
        assert len(recording.poses()) > 0
        assert recording.tags()
