"""Drivers that learn nothing: policies that never look, and highway-env's own, IDM and MOBIL."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np

from esc_agents import files
from esc_agents.config import TrainConfig
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check
from esc_agents.driving.environments import make_env
from esc_agents.driving.episodes import Episode, Policy, Summary, evaluate, return_of, table
from esc_agents.driving.vectorised import closing, unknown_to_engine, vectorise
from esc_agents.errors import say
from esc_agents.reporting.tables import markdown
from esc_gym.planning import survivable


def blind_policies(
    space: gym.Space, count: int, names: Mapping[int, str], seed: int
) -> dict[str, Policy]:
    """Every policy that does not look: each constant action, and a random one.

    space: of one environment; count: of environments; names: of discrete actions. Of continuous
    actions: the neutral one, and full throttle straight ahead where there is a throttle.
    """
    if isinstance(space, gym.spaces.Discrete):
        constants: dict[str, Any] = {
            f"always {names.get(action, action)}": action for action in range(int(space.n))
        }
    else:
        neutral = np.zeros(space.shape or (), np.float32)
        constants = {"always neutral": neutral}
        if neutral.size == 2:
            constants["always full throttle"] = np.array([1, 0], np.float32)
    policies = {name: _constant(action, count) for name, action in constants.items()}
    return policies | {"random": _random(space, count, seed)}


def _constant(action: Any, count: int) -> Policy:
    actions = np.array([action] * count)
    return lambda observations: actions


def _random(space: gym.Space, count: int, seed: int) -> Policy:
    generator = np.random.default_rng(seed)
    if isinstance(space, gym.spaces.Discrete):
        return lambda observations: generator.integers(space.n, size=count)
    shape = (count, *(space.shape or ()))
    return lambda observations: generator.uniform(-1, 1, shape).astype(np.float32)


def action_names(env: Any) -> dict[int, str]:
    """highway-env's names of the discrete actions."""
    return getattr(env.unwrapped.action_type, "actions", {})


def best_blind(blind: Mapping[str, Summary]) -> str:
    """The policy whose interval of the return reaches highest."""
    return max(blind, key=lambda name: blind[name].reward_high)


def rivals(ours: Summary, blind: Mapping[str, Summary]) -> list[str]:
    """The policies that never look whose intervals of the return reach ours."""
    return [name for name in blind if blind[name].reward_high >= ours.reward_low]


def is_above(ours: Summary, blind: Mapping[str, Summary]) -> bool:
    """Whether the interval of our return lies above those of all policies that never look."""
    return not rivals(ours, blind)


def verdict(name: str, ours: Summary, blind: Mapping[str, Summary]) -> str:
    """One sentence: is a policy above all those that never look? Else the best that it may not be
    above stands beside it."""
    if near := rivals(ours, blind):
        judged, best = "not clearly above", max(near, key=lambda each: blind[each].reward)
    else:
        judged, best = "above", best_blind(blind)
    return (
        f"{name} is {judged} every policy that never looks: {return_of(ours)} beside "
        f"{return_of(blind[best])} of {best}."
    )


def floors(config: TrainConfig, episodes: int) -> dict[str, Summary]:
    """Every blind policy of a scenario on ``episodes`` fixed seeds."""
    return {name: drive() for name, drive in blind_drives(config, episodes).items()}


def blind_drives(config: TrainConfig, episodes: int) -> dict[str, Callable[[], Summary]]:
    """By name, what has each blind policy drive ``episodes`` fixed seeds."""
    probe = check(config)
    first = config.evaluation.seed
    seeds, count = range(first, first + episodes), min(config.n_envs, episodes)
    blind = blind_policies(probe.action_space, count, action_names(probe), first)
    return {name: partial(_drive, config, policy, seeds) for name, policy in blind.items()}


def _drive(config: TrainConfig, policy: Policy, seeds: Sequence[int]) -> Summary:
    # Environments of its own: those in which another policy met a fault are of no use any more.
    with closing(vectorise(config, min(config.n_envs, len(seeds)), evaluation=True)) as envs:
        return Summary.of(evaluate(envs, policy, seeds))


def rule_driver(
    config: TrainConfig, seeds: Sequence[int], stop: Callable[[], bool] = lambda: False
) -> list[Episode]:
    """Episodes of highway-env's own driver, IDM and MOBIL, in the ego's place.

    stop: as in ``evaluate``. Raises UserError where it cannot drive.
    """
    make_env(config, rule_driver=True).close()  # here, since a worker could not say why
    count = min(config.n_envs, len(seeds))
    with closing(vectorise(config, count, evaluation=True, rule_driver=True)) as envs:
        space = envs.action_space
        ignored = np.zeros((count, *(space.shape or ())), space.dtype)
        return evaluate(envs, lambda observations: ignored, seeds, stop)


LOST = (
    "In {} of these {} episodes the ego crashes whatever it does, as far as is known: among all "
    "sequences of meta-actions, of which no more than 3,000 are followed at a time, none was found "
    "that ends without a crash (`esc_gym.planning.survivable`)."
)


def lost(config: TrainConfig, episodes: int) -> int:
    """In how many episodes no way was found that ends without a crash."""
    with closing(BatchVecEnv(config, 1, evaluation=True)) as envs:
        found, scene = 0, cast(BatchVecEnv, envs).envs
        for seed in range(config.evaluation.seed, config.evaluation.seed + episodes):
            envs.env_method("set_seeds", [seed], indices=0)
            envs.reset()
            # Few are mostly enough to find one that is alive.
            found += not (survivable(scene, 0, scenes=100) or survivable(scene, 0))
        return found


def write_floors(configs: Mapping[str, TrainConfig], episodes: int, seed: int, out: Path) -> None:
    """Measure the blind policies of scenarios, by name, and write a Markdown page of tables."""
    text = [
        "# Blind policies",
        "",
        f"Written by `python -m esc_agents.cli.floors --scenarios {' '.join(configs)} --episodes "
        f"{episodes}`: {episodes} episodes each, seeds from {seed} on; brackets hold 95 % "
        "intervals. "
        + ", ".join(f"{name} {version}" for name, version in files.versions().items())
        + ".",
    ]
    for name, config in configs.items():
        say(f"{name} ...")
        text += ["", f"## {name}", "", markdown(table(floors(config, episodes)))]
        meta = isinstance(check(config).action_space, gym.spaces.Discrete)
        if meta and not unknown_to_engine(config):
            text += ["", LOST.format(lost(config, episodes), episodes)]
    out.parent.mkdir(parents=True, exist_ok=True)
    files.write_text(out, "\n".join(text) + "\n")
    say(f"Written: {out}")
