"""Speed and memory of the commands people wait for; run with `make bench`."""
