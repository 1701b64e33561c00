"""Many environments of one scenario in one call, on exactly highway-env's trajectories."""

from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.families import Report

__all__ = ["Report", "SetVectorEnv"]
