"""Many environments of one scenario in one call, on exactly highway-env's trajectories."""
