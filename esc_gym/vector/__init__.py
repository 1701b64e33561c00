"""Many environments of one scenario in one call, on exactly highway-env's trajectories."""

from esc_gym.vector.environment import Report, SetVectorEnv

__all__ = ["Report", "SetVectorEnv"]
