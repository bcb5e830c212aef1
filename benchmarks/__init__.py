"""Speed, memory and accuracy of the commands and functions; run with `make bench` and other targets of the Makefile."""
