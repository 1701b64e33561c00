"""PPO training from start to end: stock highway-env, ours one by one, ours in a batch."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import gymnasium as gym
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

from esc_agents.config import TrainConfig
from esc_agents.driving.batch import cores
from esc_agents.driving.environments import env_config
from esc_agents.driving.vectorised import vectorise
from esc_agents.proof.timing import ratio, significant
from esc_agents.training.models import OURS, new_model

ROUNDS = 2
COLUMNS = (
    "environment", "stock steps/s", "one by one steps/s", "batch steps/s", "beside one by one",
    "beside stock", "simulating us", "learning us", "the rest us",
)  # fmt: skip
TEXT = f"""## PPO training, end to end

Environment steps per second, driving and learning. Stock: SB3's `MlpPolicy` on highway-env's
Kinematics, as many environments as processors, each in a process. Ours: ESC on the set, as
`esc-train` does it by default, in a batch, and with `--vec dummy` the same environments one by one.
Batch size, epochs, `net_arch` and all else are the same, but a stock rollout is as long as one
batch, since whole ones take minutes; every step is still learned from in the same number of batches
of the same size. They take {ROUNDS} turns each, of whole rollouts with their
updates; the fastest counts. The last three columns: what a step costs in a batch, by what it is
spent on; the rest is what SB3 does around it, and the policy's decisions.
"""


def measure(config: TrainConfig, seconds: float, say: Callable[[str], None]) -> list[str]:
    """The row of a training."""
    stock_env = partial(_stock_env, config.env, env_config(config))
    ppo = config.ppo.model_dump(exclude=OURS)
    count = min(config.n_envs, cores())
    ppo["n_steps"] = -(-config.ppo.batch_size // count)  # see TEXT
    policy = {"net_arch": list(config.ppo.net_arch), "ortho_init": config.ppo.ortho_init}
    given = {"policy_kwargs": policy, "seed": config.seed, "device": config.device}
    envs = SubprocVecEnv([stock_env] * count)
    models: list[Any] = [PPO("MlpPolicy", envs, **given, **ppo)]
    for vec in ("dummy", "auto"):
        alike = config.ppo.model_copy(update={"crash_replay": 0.0})  # which one by one cannot
        own = config.model_copy(update={"vec": vec, "ppo": alike})
        models.append(new_model(own, vectorise(own, own.n_envs)))
    try:
        rounds = [[learn(model, seconds) for model in models] for _ in range(ROUNDS)]
    finally:
        for model in models:
            model.env.close()
    stock, single, batch = (min(costs) for costs in zip(*rounds, strict=True))
    rates = [significant(1 / cost[0]) for cost in (stock, single, batch)]
    beside = [ratio(single[0], batch[0]), ratio(stock[0], batch[0])]
    say(f"PPO on {config.env}: {' -> '.join(rates)} steps/s, {' and '.join(beside)}")
    total, simulating, learning = batch
    parts = simulating, learning, total - simulating - learning
    return [config.env, *rates, *beside, *(significant(1e6 * part) for part in parts)]


def _stock_env(id: str, config: dict[str, Any]) -> gym.Env:
    return Monitor(gym.make(id, config=config, disable_env_checker=True))


def learn(model: Any, seconds: float) -> tuple[float, float, float]:
    """Seconds of an environment step, and its shares of simulating and of learning.

    In whole rollouts and their updates, ``seconds`` or more.
    """
    size, steps, before = model.n_steps * model.env.num_envs, 0, time.perf_counter()
    with timed(model.env, "step_wait") as simulating, timed(model, "train") as learning:
        while (taken := time.perf_counter() - before) < seconds:
            model.learn(size, reset_num_timesteps=False)
            steps += size
    return taken / steps, sum(simulating) / steps, sum(learning) / steps


@contextmanager
def timed(owner: Any, name: str) -> Iterator[list[float]]:
    """The seconds of all calls of a method."""
    real, found = getattr(owner, name), []

    def method(*arguments: Any) -> Any:
        before = time.perf_counter()
        try:
            return real(*arguments)
        finally:
            found.append(time.perf_counter() - before)

    setattr(owner, name, method)
    try:
        yield found
    finally:
        delattr(owner, name)
