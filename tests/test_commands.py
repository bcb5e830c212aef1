"""The three commands: versions, usage errors, Ctrl-C while they begin; and they behave in forks as in new processes."""

import subprocess
import sys

import pytest

import uwblink
from tests import processes


@pytest.mark.parametrize("command", ["uwbsim", "uwblink", "calib"])
def test_usage_errors_have_status_2(command):
    assert processes.run(command, "--nonsense").returncode == 2
    assert processes.run(command, "nonsense").returncode == 2
    assert processes.succeed(command, "--version").stdout.splitlines()[0] == f"{command} {uwblink.__version__}"


@pytest.mark.parametrize("package", ["uwbsim", "uwblink", "calib"])
@pytest.mark.parametrize("module", ["typer", "uwblink.cli.shared"])
def test_interrupted_while_it_is_imported(package, module):
    code = (
        "import os, signal, sys\n"
        "class Interrupting:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        "            os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Interrupting())\n"
        f"from {package}.cli import main\n"
        "main()\n"
    )
    done = subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "interrupted\n")


@pytest.mark.parametrize(
    "words",
    [
        ("uwbsim", "validate", "scenarios/noiseless.toml"),
        ("calib", "fit", "nowhere.uwb", "-o", "c.json"),
        ("uwblink", "nonsense"),
        ("calib", "--help"),
    ],
)
def test_status_and_output_of_a_fork_are_those_of_a_new_process(words, monkeypatch):
    monkeypatch.chdir(processes.ROOT)
    plain = subprocess.run([processes.BIN / words[0], *words[1:]], capture_output=True, text=True)
    forked = processes.run(*words)
    assert (forked.returncode, forked.stdout, forked.stderr) == (plain.returncode, plain.stdout, plain.stderr)
