"""What happens beside training: logging, evaluation on fixed seeds, checkpoints, a clean stop."""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.vec_env import VecEnv

from esc_agents.evaluate import Episode, evaluate, model_policy
from esc_agents.run import STEP, MetricsFile, write_atomically

LOGGED = {
    "return": "r",
    "collision_rate": "crashed",
    "mean_speed": "speed",
    "lane_changes": "lane_changes",
    "vehicles_in_set": "vehicles",
}


class MetricsWriter(KVWriter):
    """SB3's logger -> metrics.csv."""

    def __init__(self, path: Path, first_step: int) -> None:
        self.file = MetricsFile(path, first_step)

    def write(self, key_values: dict, key_excluded: dict, step: int = 0) -> None:
        self.file.write({STEP: step, **dict(sorted(key_values.items()))})

    def close(self) -> None:
        """Nothing stays open between rows."""


class DrivingLog(BaseCallback):
    """TensorBoard's ``driving/``: means over the last 100 training episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes: deque[dict[str, float]] = deque(maxlen=100)

    def _on_step(self) -> bool:
        if ended := [info["episode"] for info in self.locals["infos"] if "episode" in info]:
            self.episodes.extend(ended)
            for name, key in LOGGED.items():
                mean = float(np.mean([episode[key] for episode in self.episodes]))
                self.logger.record(f"driving/{name}", mean)
        return True


class FixedSeedEvaluation(BaseCallback):
    """Every ``every`` steps: the same episodes, appended to evaluations.npz; best_model.zip."""

    def __init__(self, envs: VecEnv, seeds: Sequence[int], every: int, run: Path) -> None:
        super().__init__()
        self.envs, self.seeds, self.every, self.run = envs, seeds, every, run
        self.path = run / "evaluations.npz"
        self.history: dict[str, list] = {}
        self.stopped: Callable[[], bool] = lambda: False

    def _init_callback(self) -> None:
        if self.path.is_file():
            with np.load(self.path) as saved:
                kept = saved["timesteps"] <= self.model.num_timesteps
                self.history = {name: list(saved[name][kept]) for name in saved.files}
        self._next = (self.model.num_timesteps // self.every + 1) * self.every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self.every + 1) * self.every
            episodes = evaluate(self.envs, model_policy(self.model), self.seeds, self.stopped)
            if len(episodes) == len(self.seeds):
                self._record(episodes)
        return True

    def _record(self, episodes: list[Episode]) -> None:
        rewards = [episode.reward for episode in episodes]
        best = max((np.mean(r) for r in self.history.get("results", [])), default=-np.inf)
        row = {
            "timesteps": self.num_timesteps,
            # "results" and "ep_lengths" are the names that SB3's own evaluations.npz has.
            "results": rewards,
            "ep_lengths": [episode.length for episode in episodes],
            "crashed": [episode.crashed for episode in episodes],
            "speeds": [episode.speed for episode in episodes],
        }
        for name, value in row.items():
            self.history.setdefault(name, []).append(value)
        arrays: Any = {name: np.array(values) for name, values in self.history.items()}
        write_atomically(self.path, lambda file: np.savez(file, **arrays))
        self.logger.record("eval/return", float(np.mean(rewards)))
        self.logger.record("eval/collision_rate", float(np.mean(row["crashed"])))
        if np.mean(rewards) > best:
            write_atomically(self.run / "best_model.zip", self.model.save)
        crashes = sum(row["crashed"])
        print(
            f"step {self.num_timesteps:,}: return {np.mean(rewards):.2f}, "
            f"{crashes} of {len(rewards)} evaluation episodes crashed",
            flush=True,
        )


class Checkpoints(BaseCallback):
    """checkpoints/<steps>.zip every ``every`` steps; the last two stay."""

    def __init__(self, folder: Path, every: int) -> None:
        super().__init__()
        self.folder, self.every = folder, every

    def _init_callback(self) -> None:
        self._next = (self.model.num_timesteps // self.every + 1) * self.every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self.every + 1) * self.every
            write_atomically(self.folder / f"{self.num_timesteps:012d}.zip", self.model.save)
            for old in sorted(self.folder.glob("*.zip"))[:-2]:
                old.unlink()
        return True


class StopOnInterrupt(BaseCallback):
    """Ctrl-C ends training after the current step; a second one ends the process at once."""

    def __init__(self) -> None:
        super().__init__()
        self.interrupted = False

    def __enter__(self) -> StopOnInterrupt:
        self._previous = signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        signal.signal(signal.SIGINT, self._previous)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self.interrupted:
            raise KeyboardInterrupt
        self.interrupted = True

    def _on_step(self) -> bool:
        return not self.interrupted
