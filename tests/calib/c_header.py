"""Calibrations in C: a program includes the exported header and is compiled with strict warnings."""

import shutil
import subprocess

import pytest

import calib

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")


def printed(folder, known, main, text=""):
    """Return the output of a program that includes the header of a calibration; skips without a compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    calib.export(known, "c-header", folder / "calibration.h")
    (folder / "main.c").write_text(main)
    subprocess.run([compiler, *STRICT, "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    return subprocess.run(["./main"], cwd=folder, input=text, capture_output=True, text=True, check=True).stdout
