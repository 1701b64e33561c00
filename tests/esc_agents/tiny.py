"""The smallest runs that still have everything: seconds each, on stock highway-env."""

from __future__ import annotations

from typing import Any

from esc_agents.config import TrainConfig, config_for_env

ROAD = {"vehicles_count": 6, "duration": 6, "lanes_count": 3}
RANGES = {"x": (-100, 100), "y": (-12, 12), "vx": (-20, 20), "vy": (-5, 5)}
PPO = {"n_steps": 16, "batch_size": 16, "n_epochs": 1, "net_arch": (8,)}
SAC = {
    "learning_starts": 8, "batch_size": 8, "buffer_size": 200, "net_arch": (8,), "train_freq": 8,
}  # fmt: skip
# Long enough for the four whole episodes after which SB3 logs.
SAC_RUN: dict[str, Any] = {"steps": 512, "evaluation": {"episodes": 1, "every": 256}}


def tiny(env: str = "highway-fast-v0", **changes: Any) -> TrainConfig:
    """highway-fast (6 vehicles, 6 steps an episode) or lane-keeping, one evaluation episode."""
    values = {
        **config_for_env(env).model_dump(),
        "env_config": ROAD if env == "highway-fast-v0" else {},
        **({"observation": {"ranges": RANGES}} if env == "highway-fast-v0" else {}),
        "steps": 32,
        "n_envs": 2,
        "vec": "dummy",
        "device": "cpu",
        "encoder": {"hidden": (8,), "code_dim": 200},
        "ppo": PPO,
        "sac": SAC,
        "evaluation": {"episodes": 1, "every": 16},
        **changes,
    }
    return TrainConfig.model_validate(values)
