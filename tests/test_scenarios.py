"""Every scenario in the tree runs, at a few seconds' length, and its recording opens."""

import re

import pytest

from tests import processes
from uwblink.recording.file import Recording

FOLDER = processes.ROOT / "scenarios"
SCENARIOS = {path.relative_to(FOLDER).as_posix(): path for path in sorted(FOLDER.rglob("*.toml"))}
PROMISED = """noiseless.toml broadcast.toml tdoa.toml
room/room.toml icra2023/train.toml icra2023/test1.toml icra2023/test2.toml
anchors_and_tag/anchors_and_tag.toml anchors_and_tag/bipartite.toml new_tag/new_tag.toml day30/train.toml
collisions/aloha.toml nlos_office/office.toml wrap/wrap.toml two_boards_on_a_bench/bench.toml
lasting_reflections/hall.toml warm_up/warm_up.toml bench/bench.toml mounted_differently/before.toml
mounted_differently/after.toml office/office.toml hall_with_metal/hall.toml six_robots/six_robots.toml"""
BITING = ("warm_up", "bench", "mounted_differently", "lasting_reflections", "office", "hall_with_metal", "six_robots")


def test_the_scenarios_that_the_pages_promise_are_there_and_those_that_bite_say_what_they_test():
    assert set(PROMISED.split()) <= set(SCENARIOS)
    biting = {name: path.read_text() for name, path in SCENARIOS.items() if name.split("/")[0] in BITING}
    assert [name for name, text in biting.items() if not re.search(r"^# .*Tests ", text, flags=re.MULTILINE)] == []


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
