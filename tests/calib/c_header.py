"""Calibrations in C: the header that is exported, compiled strictly with a program of the test."""

import shutil
import subprocess

import pytest

import calib

STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-pedantic", "-O2")


def printed(folder, known, main, text=""):
    """Return what a program prints that includes the header of a calibration; skips where there is no compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler on this machine")
    calib.export(known, "c-header", folder / "calibration.h")
    (folder / "main.c").write_text(main)
    subprocess.run([compiler, *STRICT, "main.c", "-o", "main", "-lm"], cwd=folder, check=True)
    return subprocess.run(["./main"], cwd=folder, input=text, capture_output=True, text=True, check=True).stdout
