"""highway-env's simulation, compiled, with the same trajectories to the last bit: README.md."""

from esc_gym.fastsim.engine import Report, accelerate, isolate, report

__all__ = ["Report", "accelerate", "isolate", "report"]
