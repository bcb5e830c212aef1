"""The three commands: help without heavy imports, versions, usage errors."""

import subprocess
import sys
from pathlib import Path

import pytest

import uwblink

BIN = Path(sys.executable).parent
HEAVY = ("matplotlib", "scipy", "duckdb", "numpy", "simpy", "pandas")


@pytest.mark.parametrize("package", ["uwbsim", "uwblink", "calib"])
def test_help_loads_nothing_heavy(package):
    code = (
        f"import sys; sys.argv=['{package}', '--help']\n"
        f"from {package}.cli import main\n"
        "try:\n    main()\nexcept SystemExit:\n    pass\n"
        f"print('LOADED', [m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert "LOADED []" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize("command", ["uwbsim", "uwblink", "calib"])
def test_usage_errors_have_status_2(command):
    assert subprocess.run([str(BIN / command), "--nonsense"], capture_output=True).returncode == 2
    assert subprocess.run([str(BIN / command), "nonsense"], capture_output=True).returncode == 2
    done = subprocess.run([str(BIN / command), "--version"], capture_output=True, text=True)
    assert done.stdout.strip() == uwblink.__version__
