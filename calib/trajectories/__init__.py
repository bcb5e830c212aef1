"""Trajectories of moving bodies, estimated from ranges together with antenna delays and curves."""
