"""SB3 models: a new one for a run, and what a run ended with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule, get_device
from stable_baselines3.common.vec_env import VecEnv

from esc_agents.config import TrainConfig, scenario_name
from esc_agents.driving.checks import check_device, extractor_arguments
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError, say
from esc_agents.training.hindsight import HindsightBuffer
from esc_gym.extractors import SetExtractor
from esc_gym.matching import parameter_count

ALGORITHMS: dict[str, type[BaseAlgorithm]] = {"ppo": PPO, "sac": SAC}
OURS = {
    "train_env_config", "net_arch", "ortho_init", "learning_rate_schedule", "ent_coef_schedule",
    "hindsight", "value_warmup", "crash_replay",
}  # fmt: skip
"""Hyperparameters that are no arguments of SB3's algorithms by these names."""


def new_model(config: TrainConfig, envs: VecEnv) -> BaseAlgorithm:
    """An untrained SB3 model of the run's algorithm and representation."""
    torch.set_num_threads(config.threads)
    chosen = config.hyperparameters
    settings = chosen.model_dump(exclude=OURS)
    if chosen.learning_rate_schedule == "linear":
        settings["learning_rate"] = LinearSchedule(chosen.learning_rate, 0.0, 1.0)
    policy: dict[str, Any] = {
        "features_extractor_class": SetExtractor,
        "features_extractor_kwargs": extractor_arguments(config),
        "net_arch": list(chosen.net_arch),
    }
    # One kernel instead of one per tensor and operation: the same Adam, a third less time.
    adam: dict[str, Any] = {"fused": True}
    if config.algo == "ppo":
        policy["ortho_init"] = config.ppo.ortho_init
        adam["eps"] = 1e-5  # what SB3 takes where it is given no arguments
        if config.ppo.use_sde:
            policy["log_std_init"] = -2.0  # of each of the many weights that add up to an action
    elif config.sac.hindsight:
        settings["replay_buffer_class"] = HindsightBuffer
    policy["optimizer_kwargs"] = adam
    try:
        return ALGORITHMS[config.algo](
            "MultiInputPolicy",  # type: ignore[arg-type]
            envs,
            policy_kwargs=policy,
            seed=config.seed,
            device=config.device,
            **settings,
        )
    except MemoryError as error:
        raise UserError(f"{config.algo}: buffer_size, n_steps or n_envs: {error}") from error


def load_model(config: TrainConfig, directory: Path, trust: bool = False) -> tuple[Any, int]:
    """(policy, training steps) of a run: what it ended with, else its best evaluated.

    From the files that hold no code; where there are none, with ``trust`` from SB3's model.zip.
    """
    check_device(config.device)
    torch.set_num_threads(config.threads)
    device = str(get_device(config.device))
    for name in ("policy", "best_policy"):
        if (directory / f"{name}.json").exists():
            return load_policy(directory, device, name, trust)
    path = directory / "model.zip"
    if not path.exists():
        raise UserError(f"{directory} holds no policy yet: expected policy.safetensors in it")
    if not trust:
        raise UserError(
            f"{path} holds pickled Python objects, and to load it can run code of whoever wrote "
            "it; add --trust if you trust them"
        )
    try:
        model = ALGORITHMS[config.algo].load(path, device=config.device)
    except Exception as error:
        raise UserError(f"{path} is damaged or of another version: {error}") from error
    say(f"Loaded {path}, which holds pickled Python objects")
    return model, model.num_timesteps


def describe(config: TrainConfig, model: BaseAlgorithm, env: Any) -> str:
    """What is about to be trained, on a line."""
    network: Any = model.policy if config.algo == "ppo" else model.policy.actor
    extractor = network.features_extractor
    n, d1 = env.observation_space["vehicles"].shape
    (d2,) = env.observation_space["ego"].shape
    return (
        f"{scenario_name(config)}: sets of up to N={n} vehicles, d1={d1}, d2={d2}; {config.repr}: "
        f"{extractor.features_dim} features, {parameter_count(extractor):,} parameters; "
        f"{config.algo} on {model.device}, {config.n_envs} environments"
    )
