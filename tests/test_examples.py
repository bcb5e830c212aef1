"""The example script of the README: it stands there as it is, runs as it is, and is short."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCRIPT = ROOT / "docs" / "examples" / "first_calibration.py"
NAMES = ("raw", "corrected")
NUMBER = r"([+-]?\d+\.\d+)"


def test_the_readme_shows_the_script():
    shown = re.search(
        r"^```python first_calibration\n(.*?)^```", (ROOT / "README.md").read_text(), flags=re.MULTILINE | re.DOTALL
    )
    assert shown[1] == SCRIPT.read_text()
    assert len(SCRIPT.read_text().splitlines()) <= 25


def test_the_script_simulates_fits_corrects_and_judges(tmp_path):
    shutil.copytree(ROOT / "scenarios", tmp_path / "scenarios")
    done = subprocess.run(
        [sys.executable, SCRIPT], cwd=tmp_path, capture_output=True, text=True, env=os.environ | {"MPLBACKEND": "Agg"}
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert (tmp_path / "bias.png").stat().st_size > 5000
    assert (tmp_path / "first.json").exists()
    one = re.search(rf"3.21 m corrected: {NUMBER} m, standard deviation {NUMBER} m", done.stdout)
    (first, *_) = re.search(r"^\[ *(\S+) +(\S+) +(\S+) *\]$", done.stdout, flags=re.MULTILINE).groups()
    # The first of the array has the same range, and both powers where the one has its first: some millimetres apart.
    assert abs(float(first) - float(one[1])) < 0.03
    assert 0.03 < float(one[2]) < 0.15
    found = [re.search(rf"^{name} +mean {NUMBER} cm.*deviation {NUMBER} cm", done.stdout, re.M) for name in NAMES]
    raw, full = found
    # What the paper's flights leave: reflections keep the mean above zero, and the spread falls to the noise's.
    assert abs(float(full[1])) < 0.6 * abs(float(raw[1]))
    assert float(full[2]) < 0.9 * float(raw[2])
