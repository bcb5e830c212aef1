"""Commands that are run in forks behave as those that are run in processes that import everything."""

import os
import subprocess
import time

import pytest

from tests import processes


@pytest.mark.parametrize(
    "words",
    [
        ("uwbsim", "validate", "scenarios/noiseless.toml"),
        ("calib", "fit", "nowhere.uwb", "-o", "c.json"),
        ("uwblink", "nonsense"),
        ("calib", "--help"),
    ],
)
def test_status_and_output_are_those_of_a_plain_process(words, monkeypatch):
    monkeypatch.chdir(processes.ROOT)
    plain = subprocess.run([processes.BIN / words[0], *words[1:]], capture_output=True, text=True)
    forked = processes.run(*words)
    assert (forked.returncode, forked.stdout, forked.stderr) == (plain.returncode, plain.stdout, plain.stderr)


def test_folder_and_environment_are_its_own(tmp_path):
    done = processes.run("uwbsim", "show", processes.ROOT / "scenarios" / "noiseless.toml", "-o", "s.svg", cwd=tmp_path)
    assert (done.returncode, [path.name for path in tmp_path.iterdir()]) == (0, ["s.svg"])
    wide = processes.run("calib", "fit", "--help", env=dict(os.environ) | {"COLUMNS": "150"})
    assert max(map(len, wide.stdout.splitlines())) > 120
    narrow = processes.run("calib", "fit", "--help", env=dict(os.environ) | {"COLUMNS": "80"})
    assert max(map(len, narrow.stdout.splitlines())) <= 80


def test_what_hangs_is_ended():
    begun = time.monotonic()
    with pytest.raises(subprocess.TimeoutExpired):
        processes.run("uwbsim", "serve", "scenarios/two_boards_on_a_bench/bench.toml", timeout=1.0, cwd=processes.ROOT)
    assert time.monotonic() < begun + 60
    assert processes.run("uwbsim", "--version").returncode == 0
