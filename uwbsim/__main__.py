"""The command `uwbsim`, as `python -m uwbsim`."""

from uwbsim.cli import main

main()
