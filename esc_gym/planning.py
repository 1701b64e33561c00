"""Looking ahead on the batch engine: what each action is worth, by driving copies of the scene on.

    planner = LookAhead(horizon=6)
    values = planner.values(envs)  # [num_envs, A]
    envs.step(planner.actions(envs))

The copies hold the simulator's whole state: what the other drivers want, and the random numbers
still to be drawn. So this is what a driver could reach who knew all, a reference and a teacher; it
is no driver that one could put on a road.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from esc_gym.vector.arguments import indices_of
from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.state import RUNNING

NEUTRAL = "IDLE"


@dataclass(frozen=True)
class LookAhead:
    """Exhaustive look-ahead: each action once, then one of a few actions to the horizon.

    horizon: policy steps looked ahead, the first action's included. continuations: names of
    meta-actions, of which each is tried after the first action; the best one counts. discount:
    gamma, of the rewards.

    Raises ValueError for a horizon below 1, a discount out of [0, 1], or no continuation.
    """

    horizon: int = 6
    continuations: tuple[str, ...] = ("IDLE", "SLOWER")
    discount: float = 1.0

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise ValueError(f"horizon: expected at least 1 step, got {self.horizon}")
        if not 0.0 <= self.discount <= 1.0:
            raise ValueError(f"discount: expected a number from 0 to 1, got {self.discount}")
        if not self.continuations:
            raise ValueError("continuations: expected at least one name of a meta-action, got none")

    def sequences(self, envs: SetVectorEnv) -> NDArray[np.int64]:
        """What is tried: [A, C, horizon], for C continuations of each of A actions.

        Raises ValueError where there are no meta-actions, or none of a continuation's name.
        """
        numbers = meta_actions(envs)
        if unknown := [name for name in self.continuations if name not in numbers]:
            raise ValueError(f"continuations: expected {', '.join(numbers)}, got {unknown[0]!r}")
        after = [numbers[name] for name in self.continuations]
        plans = np.empty((len(numbers), len(after), self.horizon), np.int64)
        plans[:, :, 0] = np.arange(len(numbers))[:, None]
        plans[:, :, 1:] = np.array(after)[:, None]
        return plans

    def values(self, envs: SetVectorEnv, indices: Sequence[int] | None = None) -> NDArray:
        """Discounted return of each action within the horizon: [num_envs or len(indices), A].

        0 where an episode has ended. ``envs`` is left as it is. Raises ValueError where the batch
        engine does not simulate it (``envs.report()``).
        """
        chosen = indices_of(range(envs.num_envs) if indices is None else indices, envs.num_envs)
        plans = self.sequences(envs)
        count = plans.shape[0] * plans.shape[1]
        actions = np.tile(plans.reshape(count, self.horizon), (len(chosen), 1))
        returns = rollouts(envs, np.repeat(chosen, count), actions, self.discount)
        return returns.reshape(len(chosen), *plans.shape[:2]).max(axis=2)

    def actions(self, envs: SetVectorEnv) -> NDArray[np.int64]:
        """The best action of each environment; of equally good ones IDLE, else the first."""
        values = self.values(envs)
        best = values.argmax(axis=1)
        neutral = meta_actions(envs).get(NEUTRAL, 0)
        return np.where(values[:, neutral] == values.max(axis=1), neutral, best)


def rollouts(envs: SetVectorEnv, indices: Any, actions: NDArray, discount: float = 1.0) -> NDArray:
    """Discounted returns of sequences of actions, driven in copies of environments.

    indices [K]: the environment that each begins in. actions [K, H, ...]. Returns [K]; nothing is
    earned after the end of an episode.
    """
    copies = envs.fork(indices)
    # What ends stays as it is: resets would cost time, and draw random numbers.
    copies.autoreset_mode = copies.engine.mode = AutoresetMode.DISABLED
    copies.rest(copies.engine.state.heads["over"] != RUNNING)
    returns = np.zeros(copies.num_envs)
    for step in range(actions.shape[1]):
        _, rewards, terminated, truncated = copies.advance(actions[:, step])
        returns += discount**step * rewards
        copies.rest(terminated | truncated)
    copies.close()
    return returns


def meta_actions(envs: SetVectorEnv) -> dict[str, int]:
    """Numbers of the meta-actions, by highway-env's names for them; ValueError without any."""
    space = envs.single_action_space
    base: Any = envs.engine.env.unwrapped if envs.engine else envs.materialise(0).unwrapped
    names = getattr(base.action_type, "actions_indexes", None)
    if names is None or not isinstance(space, gym.spaces.Discrete):
        raise ValueError(f"expected an environment with meta-actions, got the actions {space}")
    return dict(names)
