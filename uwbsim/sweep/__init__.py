"""Studies of many runs: design, executors, results."""
