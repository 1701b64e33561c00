"""A run: training, its directory, its checkpoints, its evaluation."""
