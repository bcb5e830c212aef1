"""The command `calib`, as `python -m calib`."""

from calib.cli import main

main()
