"""The exact compiled simulation; see README.md beside this file."""

from esc_gym.fastsim.engine import Report, accelerate, report

__all__ = ["Report", "accelerate", "report"]
