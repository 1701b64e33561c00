"""Learning from labels: what experts say that actions are worth."""
