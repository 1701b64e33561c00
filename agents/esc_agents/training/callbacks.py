"""What happens beside training: logging, evaluation on fixed seeds, checkpoints, a clean stop."""

from __future__ import annotations

import signal
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter
from stable_baselines3.common.vec_env import VecEnv

from esc_agents import files, workers
from esc_agents.config import TrainConfig
from esc_agents.driving.episodes import Episode, Summary, check_faults, evaluate, model_policy
from esc_agents.driving.rule_driver import RULE
from esc_agents.errors import UserError
from esc_agents.training import checkpoint
from esc_agents.training.run_directory import STEP, MetricsFile, read_evaluations

LOGGED = {
    "return": "r",
    "collision_rate": "crashed",
    "mean_speed": "speed",
    "lane_changes": "lane_changes",
    "vehicles_in_set": "vehicles",
}


class Stopped(Exception):
    """Training ends here, because somebody asked it to."""


class MetricsWriter(KVWriter):
    """SB3's logger -> metrics.csv, but for what the clock says: the same run, the same file."""

    def __init__(self, path: Path, first_step: int) -> None:
        self.file = MetricsFile(path, first_step)

    def write(self, key_values: dict, key_excluded: dict, step: int = 0) -> None:
        kept = {k: v for k, v in sorted(key_values.items()) if not k.startswith("time/")}
        self.file.write({STEP: step, **kept})

    def close(self) -> None:
        """Nothing stays open between rows."""


class DrivingLog(BaseCallback):
    """TensorBoard's ``driving/``: means over the last 100 training episodes."""

    def __init__(self) -> None:
        super().__init__()
        self.episodes: deque[dict[str, float]] = deque(maxlen=100)

    @property
    def state(self) -> list[dict[str, float]]:
        """What a checkpoint has to hold."""
        return list(self.episodes)

    @state.setter
    def state(self, episodes: list[dict[str, float]]) -> None:
        self.episodes.extend(episodes)

    def _on_step(self) -> bool:
        if ended := [info["episode"] for info in self.locals["infos"] if "episode" in info]:
            self.episodes.extend(ended)
            for name, key in LOGGED.items():
                mean = float(np.mean([episode[key] for episode in self.episodes]))
                self.logger.record(f"driving/{name}", mean)
        return True


class EntropySchedule(BaseCallback):
    """PPO's entropy coefficient, from ``ent_coef`` at the first step to 0 after the last."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.ent_coef, self.steps = config.ppo.ent_coef, config.steps

    def _on_rollout_end(self) -> None:
        model: Any = self.model
        model.ent_coef = self.ent_coef * max(0.0, 1 - self.num_timesteps / self.steps)

    def _on_step(self) -> bool:
        return True


class ValueWarmup(BaseCallback):
    """In PPO's first ``value_warmup`` steps the value network alone learns."""

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.steps = config.ppo.value_warmup

    def _on_rollout_start(self) -> None:
        policy: Any = self.model.policy
        policy.requires_grad_(self.num_timesteps >= self.steps)
        for learner in (policy.value_net, policy.mlp_extractor.value_net):
            learner.requires_grad_(True)

    def _on_step(self) -> bool:
        return True


class FixedSeedEvaluation(BaseCallback):
    """Every ``every`` steps: the same episodes, appended to evaluations.npz; the best model.

    rule: how IDM/MOBIL drives these episodes, where it can: a line says when training is above it.
    """

    def __init__(self, envs: VecEnv, seeds: Sequence[int], every: int, run: Path) -> None:
        super().__init__()
        self.envs, self.seeds, self.every, self.run = envs, seeds, every, run
        self.path = run / "evaluations.npz"
        self.history: dict[str, list] = {}
        self.rule: Summary | None = None
        self.stopped: Callable[[], bool] = lambda: False
        self.save_best: Callable[[], object] = lambda: None

    def _init_callback(self) -> None:
        if self.path.is_file():
            saved = read_evaluations(self.path)
            kept = saved["timesteps"] <= self.model.num_timesteps
            self.history = {name: list(values[kept]) for name, values in saved.items()}
        self._next = (self.model.num_timesteps // self.every + 1) * self.every

    def _on_step(self) -> bool:
        if self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self.every + 1) * self.every
            self.judge()
        return True

    def judge(self) -> None:
        """Evaluate now; raises Stopped where somebody asks to stop meanwhile."""
        episodes = evaluate(self.envs, model_policy(self.model), self.seeds, self.stopped)
        if len(episodes) < len(self.seeds):
            raise Stopped  # at once: a checkpoint from here on would miss this evaluation
        self._record(episodes)

    def _record(self, episodes: list[Episode]) -> None:
        rewards = [episode.reward for episode in episodes]
        best = max((np.mean(r) for r in self.history.get("results", [])), default=-np.inf)
        row = {
            "timesteps": self.model.num_timesteps,
            # "results" and "ep_lengths" are the names that SB3's own evaluations.npz has.
            "results": rewards,
            "ep_lengths": [episode.length for episode in episodes],
            "crashed": [episode.crashed for episode in episodes],
            "speeds": [episode.speed for episode in episodes],
        }
        for name, value in row.items():
            self.history.setdefault(name, []).append(value)
        arrays: Any = {name: np.array(values) for name, values in self.history.items()}
        files.write_atomically(self.path, lambda file: np.savez(file, **arrays))
        self.logger.record("eval/return", float(np.mean(rewards)))
        self.logger.record("eval/collision_rate", float(np.mean(row["crashed"])))
        if np.mean(rewards) > best:
            files.write_atomically(self.run / "best_model.zip", self.model.save)
            self.save_best()
        crashes = sum(row["crashed"])
        above = ""
        if self.rule and np.mean(rewards) > self.rule.reward:
            above = f"; above {RULE}'s {self.rule.reward:.2f}"
        print(
            f"step {self.model.num_timesteps:,}: return {np.mean(rewards):.2f}, "
            f"{crashes} of {len(rewards)} evaluation episodes crashed{above}",
            flush=True,
        )


class Faults(BaseCallback):
    """Ends training at the first number that is NaN or infinite, or environment that failed.

    Checkpoints come after it in the list of callbacks, so each is from before.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.config = config

    def _on_step(self) -> bool:
        check_faults(self.locals["infos"], self._where())
        return True

    def _on_rollout_start(self) -> None:
        for name, value in self.logger.name_to_value.items():
            if "loss" in name and not np.isfinite(value):
                raise UserError(f"{self._where()}: {name} is {value}")
        self.check_weights()

    def check_weights(self) -> None:
        """Raises UserError unless all weights are finite."""
        total = sum(p.detach().sum() for p in self.model.policy.parameters())
        if not np.isfinite(float(total)):
            bad = [
                name for name, p in self.model.policy.named_parameters()
                if not p.detach().isfinite().all()
            ]  # fmt: skip
            name = bad[0] if bad else "the sum of all weights"
            raise UserError(
                f"{self._where()}: after an update {name} is not finite; a smaller learning_rate "
                "may help"
            )

    def _where(self) -> str:
        return f"{self.config.env}, seed {self.config.seed}, step {self.num_timesteps:,}"


class LastingNoise(BaseCallback):
    """The random numbers of a rollout with gSDE follow from the run's seed and the steps so far.

    SB3 draws the noise right before a rollout begins, and so before its checkpoint: whoever goes on
    from there would draw another.
    """

    def __init__(self, config: TrainConfig) -> None:
        super().__init__()
        self.config = config

    def _on_rollout_start(self) -> None:
        moment = np.random.SeedSequence((self.config.seed, self.num_timesteps))
        torch.manual_seed(int(moment.generate_state(1, np.uint64)[0]))
        policy: Any = self.model.policy
        policy.reset_noise(self.config.n_envs)

    def _on_step(self) -> bool:
        return True


class Checkpoints(BaseCallback):
    """A checkpoint at the first rollout after every ``every`` steps, and where training stops.

    callbacks: all of the training, in their order.
    """

    def __init__(self, folder: Path, every: int, stopped: Callable[[], bool], say: Any) -> None:
        super().__init__()
        self.every, self.stopped = every, stopped
        self.writer = checkpoint.Writer(folder, say)
        self.callbacks: Sequence[BaseCallback] = ()

    def _init_callback(self) -> None:
        steps = self.model.num_timesteps
        self._next = (steps // self.every + 1) * self.every if steps else 0

    def _on_rollout_start(self) -> None:
        stopped = self.stopped()
        if stopped or self.num_timesteps >= self._next:
            self._next = (self.num_timesteps // self.every + 1) * self.every
            self.save()
        if stopped:
            raise Stopped

    def save(self) -> None:
        """A checkpoint of what is now; ``writer.wait()`` until it is on the disk."""
        self.writer.write(self.model.num_timesteps, checkpoint.capture(self.model, self.callbacks))

    def _on_step(self) -> bool:
        return True


class StopOnSignal:
    """Ctrl-C and SIGTERM end training at the next checkpoint; a second one at once.

    Called, it says whether it is to end, also because the process that this one works for wants it.
    """

    SIGNALS = (signal.SIGINT, signal.SIGTERM)

    def __init__(self) -> None:
        self._signalled = False

    @property
    def interrupted(self) -> bool:
        return self._signalled or workers.asked_to_stop()

    def __call__(self) -> bool:
        return self.interrupted

    def __enter__(self) -> StopOnSignal:
        self._previous = {number: signal.signal(number, self._handle) for number in self.SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._signalled:
            raise KeyboardInterrupt
        self._signalled = True
