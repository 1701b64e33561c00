"""SetVecEnv beside SB3's own DummyVecEnv of single environments."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from esc_gym import ESCExtractor, SetVecEnv

FAST = "esc_gym/highway-fast-v0"
CONFIG = {"vehicles_count": 8, "duration": 5}


def dummy(env_id, n_envs, **arguments):
    return DummyVecEnv([lambda: Monitor(gym.make(env_id, **arguments))] * n_envs)


def compare(ours, theirs, steps, always=None):
    for envs in (ours, theirs):
        envs.seed(3)
    mine, other = ours.reset(), theirs.reset()
    rng, ends = np.random.default_rng(0), []
    for _ in range(steps):
        assert set(mine) == set(other)
        for name in mine:
            np.testing.assert_array_equal(mine[name], other[name])
            assert mine[name].dtype == other[name].dtype
        actions = np.array([ours.action_space.sample() for _ in range(ours.num_envs)])
        if not ours.action_space.shape:
            actions = rng.integers(0, ours.action_space.n, ours.num_envs)
        actions[:] = actions if always is None else always
        mine, rewards, dones, infos = ours.step(actions)
        other, wanted_rewards, wanted_dones, wanted = theirs.step(actions)
        np.testing.assert_array_equal(rewards, wanted_rewards)
        assert rewards.dtype == wanted_rewards.dtype
        np.testing.assert_array_equal(dones, wanted_dones)
        for info, expected in zip(infos, wanted, strict=True):
            for name in set(info) & set(expected) - {"terminal_observation", "episode", "action"}:
                assert info[name] == expected[name], name
            assert ("episode" in info) == ("episode" in expected)
            if "episode" in info:
                assert set(expected) <= set(info)
                assert info["episode"]["l"] == expected["episode"]["l"]
                assert info["episode"]["r"] == pytest.approx(expected["episode"]["r"], abs=1e-6)
                for name, part in info["terminal_observation"].items():
                    np.testing.assert_array_equal(part, expected["terminal_observation"][name])
                ends.append(info["TimeLimit.truncated"])
    return ends


def test_as_dummy_vec_env():
    ends = compare(
        SetVecEnv("highway-fast-v0", 4, threads=2, config=CONFIG),
        dummy(FAST, 4, config=CONFIG), 30,
    )  # fmt: skip
    assert {True, False} == set(ends)


def test_continuous_actions_and_a_time_limit():
    continuous = {**CONFIG, "action": {"type": "ContinuousAction"}}
    compare(SetVecEnv(FAST, 2, config=continuous), dummy(FAST, 2, config=continuous), 12)
    limited = {"config": CONFIG, "max_episode_steps": 3}
    ends = compare(SetVecEnv(FAST, 2, **limited), dummy(FAST, 2, **limited), 10, always=4)
    assert ends == [True] * 6
    compare(SetVecEnv("two-way-v0", 2), dummy("esc_gym/two-way-v0", 2), 20)


def test_ppo_learns_the_same_weights():
    def trained(envs):
        model = PPO(
            "MultiInputPolicy", envs, n_steps=16, batch_size=32, n_epochs=2, seed=1, device="cpu",
            policy_kwargs={"features_extractor_class": ESCExtractor},
        )  # fmt: skip
        return model.learn(128)

    mine, other = trained(SetVecEnv(FAST, 4, config=CONFIG)), trained(dummy(FAST, 4, config=CONFIG))
    weights, expected = mine.policy.state_dict(), other.policy.state_dict()
    assert all((weights[name] == expected[name]).all() for name in expected)
    assert [e["l"] for e in mine.ep_info_buffer] == [e["l"] for e in other.ep_info_buffer]
    returns, _ = evaluate_policy(mine, SetVecEnv(FAST, 2, config=CONFIG), 3, warn=True)
    assert returns > 0


def test_attributes_methods_and_wrappers():
    envs = SetVecEnv(FAST, 3, config=CONFIG, render_mode="rgb_array")
    envs.seed(0)
    envs.reset()
    assert [spec.max_vehicles for spec in envs.get_attr("set_spec", [0, 2])] == [8, 8]
    masks = envs.env_method("action_masks")
    alone = gym.make(FAST, config=CONFIG)
    for seed, mask in enumerate(masks):
        alone.reset(seed=seed)
        assert (mask == alone.get_wrapper_attr("action_masks")()).all()
    assert envs.env_is_wrapped(Monitor) == [True] * 3
    assert not envs.has_attr("nothing")
    assert envs.render().ndim == 3
    with pytest.raises(AttributeError, match="state is in arrays"):
        envs.set_attr("config", {})
    envs.close()


def test_mistakes():
    with pytest.raises(TypeError, match="num_envs: as in SB3 it is n_envs here"):
        SetVecEnv(FAST, num_envs=2)
    with pytest.raises(ValueError, match="env_id: expected an id such as 'highway-v0'"):
        SetVecEnv(2)
    with pytest.raises(ValueError, match="autoreset_mode"):
        SetVecEnv(FAST, 2, autoreset_mode="NextStep")
    with pytest.raises(ValueError, match="num_envs: expected"):
        SetVecEnv(FAST, 0)
    envs = SetVecEnv(FAST, 2, config=CONFIG)
    with pytest.raises(ValueError, match=r"SetVecEnv\(..., config=...\)"):
        envs.set_options({"config": {}})
    envs.reset()
    for call in (envs.get_attr, lambda name, e: envs.env_is_wrapped(Monitor, e)):
        with pytest.raises(ValueError, match="number of an environment, 0 to 1, got 7"):
            call("config", [7])


@pytest.mark.parametrize("env_id", ["exit-v0", "intersection-v0", "lane-keeping-v0"])
def test_what_the_engine_does_not_know(env_id):
    """One by one, with the same statistics of the episodes."""
    found = []
    for accelerate in (True, False):
        envs = SetVecEnv(
            env_id, 2, collisions=True, accelerate=accelerate, max_episode_steps=6
        )  # fmt: skip
        assert envs.envs.report().engine == accelerate
        envs.seed(3)
        envs.reset()
        rng, space = np.random.default_rng(0), envs.action_space
        for _ in range(13):
            if space.shape:
                actions = rng.uniform(-1, 1, (2, *space.shape)).astype(space.dtype)
            else:
                actions = rng.integers(space.n, size=2)
            *_, infos = envs.step(actions)
            found += [info["episode"] for info in infos if "episode" in info]
    for episode in found:
        del episode["t"]
    half = len(found) // 2
    assert half >= 4
    assert found[:half] == found[half:]
    assert [episode["seed"] for episode in found[:2]] == [3, 4]
