"""Trained agents that come with the package.

from esc_agents import zoo

agent = zoo.load("highway-dense")
env = agent.make_env()
observation, info = env.reset(seed=0)
action, _ = agent.predict(observation)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from esc_agents.config import TrainConfig
from esc_agents.driving.environments import make_env
from esc_agents.driving.policies import load_policy
from esc_agents.pretrained import directory, names
from esc_agents.training.run_directory import open_run

__all__ = ["Agent", "directory", "load", "names"]


@dataclass(frozen=True)
class Agent:
    """A trained policy and what it was trained in.

    policy: of Stable-Baselines3. steps: of training. path: its run directory.
    """

    path: Path
    config: TrainConfig
    policy: Any
    steps: int

    def predict(
        self, observation: dict[str, np.ndarray], deterministic: bool = True
    ) -> tuple[np.ndarray, None]:
        """(action, None) for an observation, or actions for a batch of them."""
        return self.policy.predict(observation, deterministic=deterministic)

    def make_env(self, render_mode: str | None = None) -> gym.Env:
        """An environment like those that it was trained in."""
        return make_env(self.config, render_mode=render_mode)


def load(name: str, device: str = "cpu") -> Agent:
    """An agent of the zoo. Raises UserError where there is none of that name (``names()``)."""
    path = directory(name)
    policy, steps = load_policy(path, device)
    return Agent(path, open_run(path), policy, steps)
