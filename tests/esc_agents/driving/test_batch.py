"""A run's environments in the batch engine beside the same ones, each an object in a Worker."""

from __future__ import annotations

import re
from itertools import chain

import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.environments import factories
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError
from esc_agents.proof.soak import cases
from tests.esc_agents.tiny import tiny


def drawn(space, generator, count):
    """Random actions, gentle ones where steering hard would end the episode at once."""
    if not space.shape:
        return generator.integers(space.n, size=count)
    return (generator.uniform(-1, 1, (count, *space.shape)) * 0.3).astype(np.float32)


def compare(ours, theirs, steps):
    """Drive both; the episodes that ended."""
    for envs in (ours, theirs):
        envs.seed(3)
    mine, other = ours.reset(), theirs.reset()
    generator, episodes = np.random.default_rng(0), []
    for _ in range(steps):
        for name, part in other.items():
            np.testing.assert_array_equal(mine[name], part)
        actions = drawn(ours.action_space, generator, ours.num_envs)
        mine, rewards, dones, infos = ours.step(actions)
        other, expected_rewards, expected_dones, expected = theirs.step(actions)
        np.testing.assert_array_equal(rewards, expected_rewards)
        np.testing.assert_array_equal(dones, expected_dones)
        for info, wanted in zip(infos, expected, strict=True):
            assert ("episode" in info) == ("episode" in wanted)
            if "episode" in info:
                del info["episode"]["t"], wanted["episode"]["t"]
                assert info["episode"] == wanted["episode"]
                assert info["TimeLimit.truncated"] == wanted["TimeLimit.truncated"]
                for name, part in wanted["terminal_observation"].items():
                    np.testing.assert_array_equal(info["terminal_observation"][name], part)
                episodes.append(info["episode"])
    return episodes


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(), ids=lambda case: f"{case[0]}-{case[1].algo}")
@pytest.mark.parametrize("evaluation", [False, True])
def test_every_scenario(case, evaluation):
    _, config = case
    ours = BatchVecEnv(config, 3, evaluation=evaluation)
    theirs = DummyVecEnv(factories(config, 3, evaluation=evaluation))
    if evaluation:
        for envs in (ours, theirs):
            for e in range(3):
                envs.env_method("set_seeds", list(range(20 + e, 25, 3)), indices=e)
    episodes = compare(ours, theirs, 100)
    if evaluation:
        assert {episode["seed"] for episode in episodes} <= set(range(20, 25))


@pytest.mark.parametrize("order", ["road", "shuffled"])
def test_evaluation_twice(order):
    """Two environments with three seeds, then with one: the other rests, as what it last was."""
    config = tiny(vec="batch")
    ours = vectorise(config, 2, evaluation=True, shuffle=order == "shuffled")
    assert isinstance(ours, BatchVecEnv)
    theirs = DummyVecEnv(factories(config, 2, evaluation=True, shuffle=order == "shuffled"))
    for seeds in ([[5, 7], [6]], [[9], []], [[], []]):
        for envs in (ours, theirs):
            for e in range(2):
                envs.env_method("set_seeds", seeds[e], indices=e)
        episodes = compare(ours, theirs, 20)
        assert sorted(e["seed"] for e in episodes) == sorted(chain(*seeds))
        assert ours.get_attr("resting") == theirs.get_attr("resting") == [True, True]


def test_a_state_goes_to_another_batch_and_back():
    config = tiny(vec="batch", repr="ap")
    one, two = vectorise(config, 2), vectorise(config, 2)
    one.seed(3)
    one.reset()
    for _ in range(4):
        one.step(np.array([1, 3]))
    two.restore(one.state())
    for _ in range(20):
        (a, *rest), (b, *other) = one.step(np.array([3, 1])), two.step(np.array([3, 1]))
        assert all((a[name] == b[name]).all() for name in a)
        assert (rest[0] == other[0]).all()
        assert (rest[1] == other[1]).all()
        for info, wanted in zip(rest[2], other[2], strict=True):
            for found in (info, wanted):
                found.get("episode", {}).pop("t", None)
            assert info.get("episode") == wanted.get("episode")
    with pytest.raises(ValueError, match="of other environments"):
        vectorise(config, 3).restore(one.state())


def faults(envs, steps):
    found = []
    for _ in range(steps):
        *_, infos = envs.step(np.ones(envs.num_envs, int))
        found.append({e: info["fault"] for e, info in enumerate(infos) if "fault" in info})
    return found


def nan_in_state(envs):
    envs.envs.engine.state.vehicles["speed"][1, 0] = np.nan


def infinite_reward(envs):
    envs.envs.engine.constants[:] = np.inf


def nan_in_observation(envs):
    envs.envs.engine.spec = envs.envs.engine.spec._replace(half=envs.envs.engine.spec.half * np.nan)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (nan_in_state, "environment 1: a vehicle with NaN, infinite or enormous state"),
        (infinite_reward, "the reward is (nan|inf)"),
        (nan_in_observation, r"'x' of vehicle 0 \(id \d+\) is nan"),
    ],
)
def test_faults(spoil, message):
    envs = vectorise(tiny(vec="batch"), 2)
    envs.seed(0)
    envs.reset()
    assert faults(envs, 1) == [{}]
    constants = envs.envs.engine.constants.copy()
    spoil(envs)
    first, second = faults(envs, 2)
    ((e, text),) = first.items()
    assert e == (spoil is nan_in_state)
    assert re.fullmatch("episode 0, step 2: " + message, text)
    assert second == first
    # A reset counts lanes and vehicles by them: by infinitely many it would write anywhere.
    envs.envs.engine.constants[:] = constants
    envs.reset()


def test_sets_that_overflow():
    observation = {"max_vehicles": 3, "on_overflow": "error"}
    envs = vectorise(tiny(vec="batch", observation=observation), 2)
    envs.reset()
    (found,) = faults(envs, 1)
    assert found[0].startswith("episode 0, step 0: OverflowError: 6 vehicles within")


def test_what_cannot_be_a_batch():
    config = tiny(vec="batch", observation={"accelerate": False})
    with pytest.raises(UserError, match=r"vec: batch: .*accelerate is false; auto takes"):
        vectorise(config, 2)
    auto = config.model_copy(update={"vec": "auto"})
    assert not isinstance(vectorise(auto, 1), BatchVecEnv)
    assert not isinstance(vectorise(tiny(vec="batch"), 1, rule_driver=True), BatchVecEnv)
