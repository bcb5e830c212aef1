"""The three commands: versions, usage errors, Ctrl-C while they begin."""

import subprocess
import sys

import pytest

import uwblink
from tests import processes


@pytest.mark.parametrize("command", ["uwbsim", "uwblink", "calib"])
def test_usage_errors_have_status_2(command):
    assert processes.run(command, "--nonsense").returncode == 2
    assert processes.run(command, "nonsense").returncode == 2
    done = processes.run(command, "--version")
    assert done.stdout.splitlines()[0] == f"{command} {uwblink.__version__}"


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
