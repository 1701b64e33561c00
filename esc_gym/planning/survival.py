"""Whether there is any way to the end of an episode without a crash."""

from __future__ import annotations

import numpy as np

from esc_gym.planning.rollouts import copies, meta_actions
from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.state import RUNNING


def survivable(envs: SetVectorEnv, index: int, scenes: int = 3000, seed: int = 0) -> bool:
    """Whether environment ``index`` can be driven to the end of its episode without a crash.

    Every step, all scenes that are left are followed by every meta-action, in copies with the
    simulator's whole state, and of more than ``scenes`` of them that many are kept, drawn at random
    by ``seed``. True is proven. False is where all were lost: without a limit a proof, with it a
    strong hint. ``envs`` is left as it is. Raises ValueError where there are no meta-actions, the
    episode has ended, or the batch engine does not simulate it (``envs.report()``).
    """
    count, generator = len(meta_actions(envs)), np.random.default_rng(seed)
    now, left = copies(envs, [index]), np.array([0])
    if now.engine.state.heads["over"][0] != RUNNING:
        raise ValueError(f"environment {index}: its episode has ended")
    while len(left):
        after = np.stack(np.meshgrid(left, np.arange(count), indexing="ij"), axis=-1).reshape(-1, 2)
        kept = np.sort(generator.permutation(len(after))[:scenes])
        driven = copies(now, after[kept, 0])
        now.close()
        now = driven
        _, _, terminated, truncated = now.advance(after[kept, 1])
        crashed = terminated & now.engine.now.told.crashed
        if ((terminated | truncated) & ~crashed).any():
            break
        left = np.flatnonzero(~crashed)
    now.close()
    return len(left) > 0
