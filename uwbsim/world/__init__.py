"""Physical models: clocks, trajectories, propagation, radios."""
