"""What is there: clocks, trajectories, propagation, radios."""
