"""The batch engine as one of Stable-Baselines3's vectorised environments."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from esc_gym.registration import NAMESPACE
from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.infos import row


class SetVecEnv(VecEnv):
    """``n_envs`` environments of one id, in one compiled call, where SB3 expects a ``VecEnv``.

    What ``DummyVecEnv`` of as many ``gym.make(env_id)``, each in a ``Monitor``, gives, this gives:
    the same observations, rewards, ends and, with the same seeds, the same trained weights.

    Args:
        env_id: ``"esc_gym/highway-v0"``, or ``"highway-v0"`` for short.
        n_envs: how many.
        threads: that share the environments out among them; results do not depend on it.
        arguments: of ``SetVectorEnv`` (config=, max_vehicles=, order=, ...).

    ``infos`` hold speed and crashed of each environment, and at the end of an episode
    ``terminal_observation``, ``TimeLimit.truncated``, ``episode`` (r, l, t) and all that
    ``gym.make``'s last info holds. ``envs`` is the ``SetVectorEnv``. An attribute or a method of a
    single environment is that of a copy in the same state: calling it changes nothing here.

    Example:
        >>> from stable_baselines3 import PPO
        >>> from esc_gym import ESCExtractor, SetVecEnv
        >>> envs = SetVecEnv("highway-fast-v0", n_envs=16)
        >>> model = PPO("MultiInputPolicy", envs, n_steps=8, batch_size=64,
        ...             policy_kwargs={"features_extractor_class": ESCExtractor})
    """

    def __init__(self, env_id: str, n_envs: int = 1, threads: int = 1, **arguments: Any) -> None:
        env_id = env_id if env_id.startswith(f"{NAMESPACE}/") else f"{NAMESPACE}/{env_id}"
        arguments.setdefault("autoreset_mode", "SameStep")
        if arguments["autoreset_mode"] != "SameStep":
            raise ValueError("autoreset_mode: SB3 resets in the step that ends an episode.")
        envs: Any = gym.make_vec(
            env_id, n_envs, vectorization_mode="vector_entry_point", threads=threads, **arguments
        )
        self.envs: SetVectorEnv = envs.unwrapped
        self._actions, self._start = np.empty(0), time.time()
        self._returns, self._lengths = np.zeros(n_envs), np.zeros(n_envs, int)
        super().__init__(n_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:  # type: ignore[override]
        """Reset all environments, with the seeds of ``seed()`` if it was called."""
        if any(self._options):
            raise ValueError("options: another configuration is for SetVecEnv(..., config=...).")
        observations, infos = self.envs.reset(seed=self._seeds)
        self._reset_seeds()
        self._returns[:], self._lengths[:] = 0.0, 0
        self.reset_infos = [row(infos, e) for e in range(self.num_envs)]
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        """(observations, rewards, dones, infos), as SB3 has them."""
        observations, rewards, terminated, truncated, infos = self.envs.step(self._actions)
        self._returns += rewards
        self._lengths += 1
        dones = terminated | truncated
        columns = infos["speed"].tolist(), infos["crashed"].tolist()
        listed = [{"speed": speed, "crashed": bad} for speed, bad in zip(*columns, strict=True)]
        for e in np.flatnonzero(dones).tolist():
            listed[e] = {
                **row(infos["final_info"], e),
                "terminal_observation": infos["final_obs"][e],
                "TimeLimit.truncated": bool(truncated[e] and not terminated[e]),
                "episode": {
                    "r": float(self._returns[e]),
                    "l": int(self._lengths[e]),
                    "t": time.time() - self._start,
                },
            }
        self._returns[dones], self._lengths[dones] = 0.0, 0
        return observations, rewards.astype(np.float32), dones, listed

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return list(self.envs.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Of the batch if it has it, else of copies of the environments."""
        chosen = list(self._get_indices(indices))
        if hasattr(self.envs, attr_name):
            return [getattr(self.envs, attr_name)] * len(chosen)
        return [self.envs.materialise(e).get_wrapper_attr(attr_name) for e in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(
            f"{attr_name!r} cannot be set: the environments' state is in arrays; give what is to "
            "be different to SetVecEnv (config=...), or use make_vec_env."
        )

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """The results of a method of copies of the environments."""
        methods = self.get_attr(method_name, indices)
        return [method(*method_args, **method_kwargs) for method in methods]

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
        """A ``Monitor`` is there: its ``episode`` is in the infos."""
        return [wrapper_class is Monitor for _ in self._get_indices(indices)]
