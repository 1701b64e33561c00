"""What going back to earlier states costs PPO, as a share of a training step."""

from __future__ import annotations

import time
from typing import Any

from esc_agents.config import config_for_env
from esc_agents.driving.crash_replay import BEYOND, EVERY
from esc_agents.driving.vectorised import vectorise
from esc_agents.training.models import new_model


def test_crash_replay_costs_less_than_five_percent(benchmark: Any) -> None:
    config = config_for_env("intersection-dense")
    config = config.model_copy(update={"ppo": config.ppo.model_copy(update={"crash_replay": 0.0})})
    envs: Any = vectorise(config, config.n_envs)
    model, steps = new_model(config, envs), config.ppo.n_steps * config.n_envs
    model.learn(steps)
    start = time.perf_counter()
    model.learn(4 * steps, reset_num_timesteps=False)
    per_step = (time.perf_counter() - start) / (4 * steps)
    kept = envs.envs.keep([0])

    def keep_and_go_back() -> None:
        """As often as if all were replays, one after the other and as short as they can be."""
        for _ in range(BEYOND):
            envs.envs.keep(range(config.n_envs))
        for e in range(EVERY * config.n_envs):
            envs.envs.go_back([e % config.n_envs], kept)

    benchmark.pedantic(keep_and_go_back, rounds=10)
    share = benchmark.stats.stats.median / (per_step * EVERY * BEYOND * config.n_envs)
    benchmark.extra_info |= {"going back / training": share}
    print({"going back / training": round(share, 4)})  # noqa: T201
    assert share <= 0.05
