"""The environments of a run in the batch engine: what one by one in ``Worker``s they would give."""

from __future__ import annotations

import os
import pickle
from collections.abc import Sequence
from typing import Any

import numpy as np

from esc_agents.config import TrainConfig
from esc_agents.driving.crash_replay import CrashReplay
from esc_agents.driving.environments import env_config, named_version, observation_arguments
from esc_agents.driving.wrappers import REFERENCE_SPEED, not_finite
from esc_gym.sb3 import SetVecEnv
from esc_gym.vector.measures import Measured


def cores() -> int:
    """How many processors this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


class BatchVecEnv(SetVecEnv):
    """``count`` environments of a run: ``Progress``, ``SeededEpisodes`` and ``Worker`` in one.

    shuffle, evaluation: as in ``make_env``; with the latter, environments play the seeds of
    ``set_seeds``, one episode each, and then rest.
    """

    def __init__(
        self, config: TrainConfig, count: int, shuffle: bool = False, evaluation: bool = False
    ) -> None:
        with named_version():
            super().__init__(
                config.env, count, cores(), evaluation,
                config=env_config(config), **observation_arguments(config, shuffle),
            )  # fmt: skip
        task = config.continuous if config.algo == "sac" else None
        self.progress_reward = task.progress_reward if task else 0.0
        self.offroad_terminal = bool(task and task.offroad_terminal)
        self.evaluation = evaluation
        self.replay: CrashReplay | None = None
        if config.algo == "ppo" and config.ppo.crash_replay and not evaluation:
            half = config.steps // count // 2
            self.replay = CrashReplay(self.envs, config.ppo.crash_replay, half, config.seed)
        self._queues: list[list[int]] = [[] for _ in range(count)]
        self.resting = np.zeros(count, bool)
        # The present observations, and the first ones of each episode, which one shows that rests.
        self._seen: dict[str, np.ndarray] = {}
        self._firsts: dict[str, np.ndarray] = {}
        self._fault: tuple[int, str] | None = None
        self._numbers, self._steps = np.full(count, -1), np.zeros(count, int)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """``set_seeds`` is a matter of this class."""
        if method_name != "set_seeds":
            return super().env_method(method_name, *method_args, indices=indices, **method_kwargs)
        for e in self._get_indices(indices):
            self._queues[e] = list(*method_args)
        return []

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """``resting`` is a matter of this class."""
        if attr_name != "resting":
            return super().get_attr(attr_name, indices)
        return self.resting[list(self._get_indices(indices))].tolist()

    def state(self) -> bytes:
        """Everything that the future depends on."""
        replay = [self.replay.state()] if self.replay else []
        return pickle.dumps((self.envs.snapshot(), vars(self.episodes), self._numbers, *replay))

    def restore(self, state: bytes) -> None:
        """Go on where ``state`` was taken. Raises ValueError for one of other environments."""
        snapshot, episodes, numbers, *replay = pickle.loads(state)
        if bool(replay) != bool(self.replay):
            raise ValueError("expected a state with the same ppo.crash_replay, none or some")
        if episodes.keys() != vars(self.episodes).keys():
            raise ValueError("statistics of episodes of another version of esc_gym")
        self._seen, _ = self.envs.restore(snapshot)
        vars(self.episodes).update(episodes)
        self._numbers = numbers
        if self.replay:
            self.replay.restore(*replay)

    def reset(self) -> dict[str, np.ndarray]:  # type: ignore[override]
        """A fault of it is told with the next step."""
        self._fault = None
        try:
            return super().reset()
        except Exception as error:
            self._note(error)
            return self._rest()

    def step_wait(self) -> Any:
        """From the first fault on, only that; ``infos`` hold it, as those of ``Worker`` do."""
        if self._fault is None:
            self._steps = self.episodes.lengths + 1
            try:
                if not self.replay:
                    return super().step_wait()
                self.replay.before_step()
                replayed = self.replay.replaying
                observations, rewards, dones, infos = super().step_wait()
                for e in np.flatnonzero(dones & replayed).tolist():
                    for name in ("episode", "is_success"):  # SB3's statistics are of whole ones
                        infos[e].pop(name, None)
                return observations, rewards, dones, infos
            except Exception as error:
                self._note(error)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if self._fault:
            infos[self._fault[0]]["fault"] = self._fault[1]
        nothing = np.zeros(self.num_envs, np.float32)
        return self._rest(), nothing, np.zeros(self.num_envs, bool), infos

    def _begin(self, chosen: np.ndarray, seeds: Sequence[int | None]) -> dict[str, np.ndarray]:
        if self.evaluation:
            queued = np.array([bool(queue) for queue in self._queues])
            self.resting[chosen] = ~queued[chosen]
            chosen = chosen & queued if self._firsts else chosen
            seeds = [self._queues[e].pop(0) if chosen[e] and queued[e] else seed
                     for e, seed in enumerate(seeds)]  # fmt: skip
        if chosen.any():
            self._numbers[chosen] += 1
            self._steps[chosen] = 0
            self._seen = super()._begin(chosen, seeds)
            if self.replay and (replayed := self.replay.begin(chosen)).any():
                self._seen = self.envs._observation(self.envs.engine.now)
                self._note_beginning(replayed)
            self._check(np.zeros(self.num_envs))
        if self.evaluation:
            for name, part in self._seen.items():
                first = self._firsts.setdefault(name, part.copy())
                first[chosen] = part[chosen]
                part[self.resting] = first[self.resting]
            self.envs.rest(self.resting)
        return self._seen

    def _judged(
        self, rewards: np.ndarray, terminated: np.ndarray, truncated: np.ndarray, measured: Measured
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        driving = ~self.resting
        if self.progress_reward:
            rewards[driving] += (self.progress_reward * measured.along / REFERENCE_SPEED)[driving]
        if self.offroad_terminal:
            terminated |= driving & ~measured.on_road
        if self.replay:
            over = self.replay.after_step(terminated & measured.crashed, self.episodes.lengths + 1)
            truncated = truncated | over
        self._check(rewards)
        return rewards, terminated, truncated

    def _listed(self, measured: Measured) -> list[dict[str, Any]]:
        if not self.evaluation:
            return super()._listed(measured)
        said = self.envs.told(np.arange(self.num_envs), self._actions)()
        return [{} if rests else info for rests, info in zip(self.resting, said, strict=True)]

    def _check(self, rewards: np.ndarray) -> None:
        """Raises ValueError where something that was returned is NaN or infinite."""
        finite = np.isfinite(rewards)
        for part in (self._seen["ego"], self._seen["vehicles"]):
            finite &= np.isfinite(part).reshape(self.num_envs, -1).all(axis=1)
        if not finite.all():
            e = self.envs.engine.faulty = int(np.argmin(finite))
            seen = {name: part[e] for name, part in self._seen.items()}
            ids = self.envs.engine.now.seen.ids[e].tolist()
            raise ValueError(not_finite(seen, rewards[e], self.envs.set_spec, ids))

    def _note(self, error: Exception) -> None:
        e = self.envs.engine.faulty
        kind = "" if isinstance(error, ValueError) else f"{type(error).__name__}: "
        self._fault = e, f"episode {self._numbers[e]}, step {self._steps[e]}: {kind}{error}"

    def _rest(self) -> dict[str, np.ndarray]:
        spaces: Any = self.observation_space
        zeros = {name: np.zeros((self.num_envs, *space.shape), space.dtype)
                 for name, space in spaces.items()}  # fmt: skip
        return {name: np.where(np.isfinite(part), part, 0).astype(part.dtype)
                for name, part in (self._seen or zeros).items()}  # fmt: skip
