"""The command `uwblink`, as `python -m uwblink`."""

from uwblink.cli import main

main()
