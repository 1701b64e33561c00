"""A batch against stock environments, one by one, compared to the last bit.

What is compared is what ``fastsim.lockstep`` compares: all that a step returns, and all that the
next step depends on, of the objects that the batch makes of its arrays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from esc_gym.vector import infos as infos_module
from esc_gym.vector.environment import SetVectorEnv
from tests.esc_gym.fastsim.lockstep import RETURNED, choose, differences, fresh_process, snapshot

# The engine drives linear vehicles without collecting the data that they fit parameters to.
ABOUT_THE_ACTION = "lane_change_reward", "action_reward"
UNRECORDED = {"data", "collecting_data"}


def stock(env_id: str, config: dict[str, Any], **observation: Any) -> gym.Env:
    """highway-env's own simulation under the Python observation."""
    return gym.make(env_id, config=config, accelerate=False, **observation)


def batch(env_id: str, count: int, config: dict[str, Any], **arguments: Any) -> SetVectorEnv:
    envs = gym.make_vec(env_id, count, config=config, **arguments)
    assert isinstance(envs, SetVectorEnv)
    assert envs.report().engine, str(envs.report())
    return envs


def row(infos: dict[str, Any], e: int) -> dict[str, Any]:
    """The info of environment ``e``, as a single environment has it."""
    found = infos_module.rows(infos, [e])[0]
    for name in ("agents_rewards", "agents_terminated"):
        if name in found:
            found[name] = tuple(found[name].tolist())
    return found


def observed(observations: dict[str, np.ndarray], e: int) -> dict[str, np.ndarray]:
    return {name: part[e] for name, part in observations.items()}


def episodes(env: gym.Env, seed: int, steps: int) -> Iterator[dict[str, Any]]:
    """What one stock environment does in ``steps`` calls of a NEXT_STEP batch after a reset."""
    observation, info = env.reset(seed=seed)
    rng, over = np.random.default_rng(seed), True
    for step in range(steps + 1):
        action = choose(env.action_space, rng, sensible=seed % 2 == 1) if step else None
        if over:
            if step:
                observation, info = env.reset()
            # The action was drawn from a generator of the process.
            del info["action"]
            for name in ABOUT_THE_ACTION:
                info.get("rewards", {}).pop(name, None)
            returned = observation, 0.0, False, False, info
        else:
            observation, reward, *ends, info = env.step(action)
            returned = observation, float(reward), *ends, info  # racetracks: of the action's type
        over = bool(returned[2] or returned[3])
        yield {"action": action, "snapshot": snap(env, dict(zip(RETURNED, returned, strict=True)))}


def snap(env: gym.Env, returned: dict[str, Any]) -> dict[str, Any]:
    found = snapshot(env, returned)
    for thing in found["object"].values():
        for name in UNRECORDED:
            thing.pop(name, None)
    return found


def check(when: str, expected: Any, found: Any) -> None:
    different = list(differences(expected, found))
    assert not different, f"{when}: {len(different)} differences\n" + "\n".join(
        f"  {where}: stock {x!r:.200}, batch {y!r:.200}" for where, x, y in different[:6]
    )


def compare(
    env_id: str,
    config: dict[str, Any] | None = None,
    *,
    seeds: Sequence[int],
    steps: int,
    threads: int = 1,
    disturbed: bool = False,
    **observation: Any,
) -> list[list[dict[str, Any]]]:
    """Raise AssertionError at the first difference; return what the stock side did, per seed.

    disturbed: in the middle, go on with a fork of a batch that was driven elsewhere and restored.
    """
    config = config or {}
    with fresh_process():
        expected = [
            list(episodes(stock(env_id, config, **observation), seed, steps)) for seed in seeds
        ]
    with fresh_process():
        envs = batch(env_id, len(seeds), config, threads=threads, **observation)
    with fresh_process():
        observations, infos = envs.reset(seed=list(seeds))
        returned = observations, *np.zeros((3, len(seeds))), infos
        for step in range(steps + 1):
            actions = np.array([episode[step]["action"] for episode in expected])
            if step:
                returned = envs.step(actions)
            if disturbed and step == steps // 2:
                envs = elsewhere_and_back(envs, actions)
            for e, seed in enumerate(seeds):
                mine = (
                    observed(returned[0], e), float(returned[1][e]), bool(returned[2][e]),
                    bool(returned[3][e]), row(returned[4], e),
                )  # fmt: skip
                found = snap(envs.materialise(e), dict(zip(RETURNED, mine, strict=True)))
                check(f"seed {seed}, call {step}", expected[e][step]["snapshot"], found)
    envs.close()
    return expected


def elsewhere_and_back(envs: SetVectorEnv, actions: np.ndarray) -> SetVectorEnv:
    """A copy of a batch that was driven on and restored since."""
    taken = envs.snapshot()
    for _ in range(3):
        envs.step(actions)
    envs.restore(taken)
    return envs.fork(range(envs.num_envs))


def resets(expected: list[list[dict[str, Any]]]) -> list[int]:
    """How often each stock environment began an episode."""
    return [sum(call["snapshot"]["steps"] == 0 for call in calls) for calls in expected]
