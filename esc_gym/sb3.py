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
from esc_gym.vector.arguments import index_of
from esc_gym.vector.environment import SetVectorEnv
from esc_gym.vector.measures import Measured, count_step


class Episodes:
    """What there is to say of the episodes of E environments, kept in arrays until they end.

    count: E; frequency: of policy steps [Hz].
    """

    def __init__(self, count: int, frequency: float) -> None:
        self.frequency = float(frequency)
        self.lengths = np.zeros(count, np.int64)
        # Of every step, as sums depend on the order.
        self.returns, self.speeds = np.zeros((2, count, 64))
        self.vehicles = np.zeros(count, np.int64)
        self.progress, self.least_time = np.zeros(count), np.full(count, np.inf)
        self.off_road, self.changes = np.zeros((2, count), np.int64)
        self.road, self.lane = np.zeros((2, count), np.int64)
        self.crashed = np.zeros(count, bool)
        self.seeds: list[int | None] = [None] * count

    def begin(self, chosen: np.ndarray, seeds: Sequence[int | None]) -> None:
        """New episodes where ``chosen`` says so."""
        for numbers in (self.lengths, self.vehicles, self.progress, self.off_road, self.changes):
            numbers[chosen] = 0
        self.least_time[chosen] = np.inf
        for e in np.flatnonzero(chosen).tolist():
            self.seeds[e] = seeds[e]

    def note_lanes(self, chosen: Any, measured: Measured) -> None:
        """Where the cars of some environments are, for the changes to count."""
        self.road[chosen], self.lane[chosen] = measured.road[chosen], measured.lane[chosen]

    def add(self, rewards: np.ndarray, counts: np.ndarray, measured: Measured) -> None:
        """A step of all environments."""
        if self.lengths.max() == self.returns.shape[1]:
            self.returns, self.speeds = (
                np.concatenate([series, np.zeros_like(series)], axis=1)
                for series in (self.returns, self.speeds)
            )
        count_step(
            self.lengths, self.returns, self.speeds, self.vehicles, self.progress,
            self.least_time, self.off_road, self.changes, self.road, self.lane,
            rewards, np.ascontiguousarray(counts), self.frequency, measured.speed, measured.along,
            measured.on_road, measured.road, measured.lane, measured.time,
        )  # fmt: skip
        self.crashed = measured.crashed.copy()

    def summaries(self, chosen: np.ndarray) -> list[dict[str, Any]]:
        """The episodes of some environments, in each of which a step was made.

        r return, l length [policy steps], crashed (0 or 1), speed (mean, m/s), progress (way made
        along the lanes, m), off_road (share of the steps), lane_changes (count), vehicles (mean M),
        min_ttc (least time to collision, s; inf where there was never one, or none was measured),
        seed (of the reset; None if there was none).
        """
        lengths = self.lengths[chosen]
        ends = list(zip(chosen.tolist(), lengths.tolist(), strict=True))
        columns = {
            "r": [sum(self.returns[e, :end].tolist()) for e, end in ends],
            "l": lengths.tolist(),
            "crashed": self.crashed[chosen].astype(int).tolist(),
            "speed": [float(np.add.reduce(self.speeds[e, :end]) / end) for e, end in ends],
            "progress": self.progress[chosen].tolist(),
            "off_road": (self.off_road[chosen] / lengths).tolist(),
            "lane_changes": self.changes[chosen].tolist(),
            "vehicles": (self.vehicles[chosen] / lengths).tolist(),
            "min_ttc": self.least_time[chosen].tolist(),
            "seed": [self.seeds[e] for e, _ in ends],
        }
        return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _copied(observations: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Observations that the next step does not overwrite."""
    return {name: part.copy() for name, part in observations.items()}


class SetVecEnv(VecEnv):
    """``n_envs`` environments of one id, in one compiled call, where SB3 expects a ``VecEnv``.

    What ``DummyVecEnv`` of as many ``gym.make(env_id)``, each in a ``Monitor``, gives, this gives:
    the same observations, rewards, ends and, with the same seeds, the same trained weights.

    Args:
        env_id: ``"esc_gym/highway-v0"``, or ``"highway-v0"`` for short.
        n_envs: how many.
        threads: that share the environments out among them; results do not depend on it.
        collisions: also measure times to collision, ``min_ttc`` of an episode.
        arguments: of ``SetVectorEnv`` (config=, max_vehicles=, order=, ...).

    ``infos`` hold speed and crashed of each environment, and at the end of an episode
    ``terminal_observation``, ``TimeLimit.truncated``, ``episode`` (see ``Episodes``) and all that
    ``gym.make``'s last info holds. ``envs`` is the ``SetVectorEnv``. An attribute or a method of a
    single environment is that of a copy in the same state: calling it changes nothing here.

    Example:
        >>> from stable_baselines3 import PPO
        >>> from esc_gym import ESCExtractor, SetVecEnv
        >>> envs = SetVecEnv("highway-fast-v0", n_envs=16)
        >>> model = PPO("MultiInputPolicy", envs, n_steps=8, batch_size=64,
        ...             policy_kwargs={"features_extractor_class": ESCExtractor})
    """

    def __init__(
        self, env_id: str, n_envs: int = 1, threads: int = 1, collisions: bool = False,
        **arguments: Any,
    ) -> None:  # fmt: skip
        if not isinstance(env_id, str):
            raise ValueError(f"env_id: expected an id such as 'highway-v0', got {env_id!r}.")
        env_id = env_id if env_id.startswith(f"{NAMESPACE}/") else f"{NAMESPACE}/{env_id}"
        if "num_envs" in arguments:
            raise TypeError("num_envs: as in SB3 it is n_envs here.")
        if "autoreset_mode" in arguments:
            raise ValueError(
                "autoreset_mode: leave it out; with SB3 the step that ends an episode resets."
            )
        # Reset here, after everything that there is to say of the last step.
        envs: Any = gym.make_vec(
            env_id, n_envs, vectorization_mode="vector_entry_point", threads=threads, copy=False,
            autoreset_mode="Disabled", **arguments,
        )  # fmt: skip
        self.envs: SetVectorEnv = envs.unwrapped
        self.collisions = collisions
        self._actions, self._start = np.empty(0), time.time()
        self.episodes = Episodes(n_envs, self.envs.config["policy_frequency"])
        super().__init__(n_envs, self.envs.single_observation_space, self.envs.single_action_space)

    def reset(self) -> dict[str, np.ndarray]:  # type: ignore[override]
        """Reset all environments, with the seeds of ``seed()`` if it was called."""
        seeds = self._seeds
        self._reset_seeds()
        return _copied(self._begin(np.ones(self.num_envs, bool), seeds))

    def set_options(self, options: Any = None) -> None:
        """There are none; raises ValueError for any."""
        if options:
            raise ValueError("options: another configuration is for SetVecEnv(..., config=...).")

    def _get_indices(self, indices: Any) -> list[int]:
        return [index_of(index, self.num_envs) for index in super()._get_indices(indices)]

    def _begin(self, chosen: np.ndarray, seeds: Sequence[int | None]) -> dict[str, np.ndarray]:
        """Begin new episodes where ``chosen`` says so; the observations of all environments."""
        observations = self.envs.begin(seeds, chosen)
        self.episodes.begin(chosen, seeds)
        self._note_beginning(chosen)
        return observations

    def _note_beginning(self, chosen: np.ndarray) -> None:
        """Where episodes that have just begun begin, and what their environments say of it."""
        begun = np.flatnonzero(chosen)
        told = self.envs.told(begun)
        for i, e in enumerate(begun.tolist()):
            self._begun[e] = told, i
        self.episodes.note_lanes(chosen, self.envs.measure(self.collisions))

    @property
    def reset_infos(self) -> list[dict[str, Any]]:  # type: ignore[override]
        """What each environment said at its last reset."""
        return [told()[i] if told else {} for told, i in self._begun]

    @reset_infos.setter
    def reset_infos(self, infos: Any) -> None:  # type: ignore[override]
        """``VecEnv`` begins with empty ones."""
        self._begun: list[Any] = [(None, 0) for _ in infos]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        """(observations, rewards, dones, infos), as SB3 has them."""
        observations, rewards, terminated, truncated = self.envs.advance(self._actions)
        measured = self.envs.measure(self.collisions)
        rewards, terminated, truncated = self._judged(rewards, terminated, truncated, measured)
        self.episodes.add(rewards, self.envs.counts, measured)
        dones, listed = terminated | truncated, self._listed(measured)
        if dones.any():
            ended, now = np.flatnonzero(dones), time.time() - self._start
            last = {name: part[ended] for name, part in observations.items()}
            said = self.envs.told(ended, self._actions)(), self.episodes.summaries(ended)
            for i, (e, info, episode) in enumerate(zip(ended.tolist(), *said, strict=True)):
                listed[e] = info | {
                    "terminal_observation": {name: part[i] for name, part in last.items()},
                    "TimeLimit.truncated": bool(truncated[e] and not terminated[e]),
                    "episode": episode | {"t": now},
                }
            observations = self._begin(dones, [None] * self.num_envs)
        return _copied(observations), rewards.astype(np.float32), dones, listed

    def _judged(
        self, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray, measured: Measured
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """For subclasses: other rewards and ends."""
        return rewards, terminated, truncated

    def _listed(self, measured: Measured) -> list[dict[str, Any]]:
        """What each environment says of a step in mid-episode."""
        columns = measured.speed.tolist(), measured.crashed.tolist()
        return [{"speed": speed, "crashed": bad} for speed, bad in zip(*columns, strict=True)]

    def close(self) -> None:
        self.envs.close()

    def get_images(self) -> Sequence[np.ndarray | None]:
        return list(self.envs.render() or [None] * self.num_envs)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """Of the batch if it has it, else of copies of the environments."""
        chosen = self._get_indices(indices)
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
