"""What a comparison will cost, from short trainings on this machine."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from esc_agents.config import TrainConfig
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.training.models import new_model
from esc_agents.workers import SPAWN

LEAST_SECONDS = 2.0


@dataclass(frozen=True)
class Cost:
    """steps: training steps a second, evaluations not counted; memory: of the process [bytes]."""

    steps: float
    memory: int


def costs(configs: Sequence[TrainConfig]) -> list[Cost]:
    """Measured one after the other in a process of their own, whose memory is of all so far."""
    with SPAWN.Pool(1) as pool:
        return pool.map(_cost, configs, chunksize=1)


def _cost(config: TrainConfig) -> Cost:
    with closing(vectorise(config, config.n_envs)) as envs:
        model: Any = new_model(config, envs)
        rollout = config.ppo.n_steps * config.n_envs
        if config.algo == "sac":
            rollout = config.sac.learning_starts + 100 * config.n_envs
        model.learn(rollout)  # compiles, and collects what SAC starts with
        begun, start = model.num_timesteps, time.perf_counter()
        while (took := time.perf_counter() - start) < LEAST_SECONDS:
            more = rollout if config.algo == "ppo" else 20 * config.n_envs
            model.learn(more, reset_num_timesteps=False)
        rate = (model.num_timesteps - begun) / took
        unit = 1 if sys.platform == "darwin" else 1024
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
        return Cost(rate, memory + _unfilled(getattr(model, "replay_buffer", None)))


def _unfilled(buffer: Any) -> int:
    """Bytes of a replay buffer that the system has promised, and will have to give."""
    if buffer is None:
        return 0
    arrays = [buffer.actions, buffer.rewards, buffer.dones, buffer.timeouts]
    arrays += [*buffer.observations.values(), *buffer.next_observations.values()]
    return sum(array.nbytes for array in arrays)
