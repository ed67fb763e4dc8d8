"""True poses for pose estimators, robots and trajectories."""
