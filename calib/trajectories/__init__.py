"""Trajectories of moving bodies, found from ranges together with antenna delays and curves."""
