"""What a checkpoint costs PPO, as a share of the time between two at the default interval."""

from __future__ import annotations

import time
from typing import Any

from esc_agents.config import config_for_env
from esc_agents.driving.vectorised import vectorise
from esc_agents.training import checkpoint
from esc_agents.training.models import new_model


def test_checkpoints_cost_less_than_three_percent(benchmark: Any, tmp_path: Any) -> None:
    config = config_for_env("highway-v0")
    envs = vectorise(config, config.n_envs)
    model = new_model(config, envs)
    model.learn(config.ppo.n_steps * config.n_envs)
    steps = 4 * config.ppo.n_steps * config.n_envs
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    per_step = (time.perf_counter() - start) / steps
    writer = checkpoint.Writer(tmp_path, print)

    def save() -> None:  # the background's part counts whole, as if there were one core
        writer.write(model.num_timesteps, checkpoint.capture(model, []))
        writer.wait()

    benchmark.pedantic(save, rounds=10)
    share = benchmark.stats.stats.median / (per_step * config.checkpoint_every)
    benchmark.extra_info |= {"checkpoint / interval": share}
    print({"checkpoint / interval": round(share, 5), "bytes": path_size(tmp_path)})  # noqa: T201
    assert share <= 0.03


def path_size(folder: Any) -> int:
    return max(path.stat().st_size for path in folder.iterdir())
