"""Plan on copies of the scene: what each meta-action is worth, and a drive that takes the best."""

from typing import Any

import gymnasium as gym
import numpy as np

import esc_gym  # noqa: F401
from esc_gym.planning import LookAhead, TreeSearch, meta_actions

envs: Any = gym.make_vec("esc_gym/merge-v1", 8)
envs.reset(seed=0)
names = list(meta_actions(envs))
print(
    "worth:", dict(zip(names, LookAhead(horizon=6).values(envs)[0].round(2).tolist(), strict=True))
)

# Whoever knows all knows what the others want; whoever observes guesses it, four times over.
for planner in (
    LookAhead(horizon=6),
    LookAhead(horizon=6, knows="observed"),
    TreeSearch(horizon=8),
):
    envs.reset(seed=0)
    returns, driving = np.zeros(8), np.ones(8, bool)
    while driving.any():
        _, rewards, terminated, truncated, _ = envs.step(planner.actions(envs))
        returns += rewards * driving
        driving &= ~(terminated | truncated)
    print(f"{type(planner).__name__}, knows {planner.knows}: mean return {returns.mean():.2f}")
