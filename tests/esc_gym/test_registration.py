"""The registered ids: all of them made, checked and driven; configuration; refusals."""

from __future__ import annotations

import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

import esc_gym
from esc_gym.registration import HIGHWAY_ENV_IDS, MULTI_AGENT_IDS, merge_config
from tests.esc_gym.road import assert_same_set, expected_set


def test_counts():
    assert len(HIGHWAY_ENV_IDS) == 31
    assert len(esc_gym.ENV_IDS) == 28
    assert set(esc_gym.ENV_IDS) <= set(gym.registry)


@pytest.mark.parametrize("env_id", esc_gym.ENV_IDS)
@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version.*:UserWarning")
def test_check_env(env_id):
    sb3_check_env(gym.make(env_id), warn=False)
    gymnasium_check_env(gym.make(env_id, disable_env_checker=True), skip_render_check=True)


@pytest.mark.parametrize("env_id", esc_gym.ENV_IDS)
def test_three_seeded_episodes(env_id):
    """Every observation in its space, finite, and the set that a look at the road gives."""
    env = gym.make(env_id, disable_env_checker=True)
    kind, expected = env.unwrapped.observation_type, []
    observe = kind.observe

    def look_then_observe():
        expected.append(expected_set(env, 200.0, kind.spec.frame))
        return observe()

    kind.observe = look_then_observe

    def check(observation, info):
        assert observation in env.observation_space
        assert all(np.isfinite(value).all() for value in observation.values())
        count, n = info["set"]["count"], kind.spec.max_vehicles
        assert observation["mask"].tolist() == [1] * count + [0] * (n - count)
        assert not observation["vehicles"][count:].any()
        rows = env.get_wrapper_attr("decode")(observation)["vehicles"][:count]
        assert_same_set(rows, expected[-1])

    for seed in range(3):
        check(*env.reset(seed=seed))
        env.action_space.seed(seed)
        ended = False
        while not ended:
            observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
            check(observation, info)
            assert np.isfinite(reward)
            ended = terminated or truncated
    env.close()


@pytest.mark.parametrize("base_id", MULTI_AGENT_IDS)
def test_multi_agent_ids_say_what_is_supported(base_id):
    with pytest.raises(gym.error.UnregisteredEnv, match="supports the 28 single-agent"):
        gym.make(f"esc_gym/{base_id}")


def test_made_without_an_import():
    code = (
        "import gymnasium as gym; env = gym.make('esc_gym:esc_gym/highway-fast-v0'); "
        "assert set(env.reset(seed=0)[0]) == {'ego', 'vehicles', 'mask'}"
    )
    subprocess.run([sys.executable, "-W", "error::UserWarning", "-c", code], check=True)


def test_configuration_is_merged():
    config = {"lanes_count": 2, "action": {"target_speeds": [10, 20]}}
    env = gym.make("esc_gym/highway-fast-v0", config=config)
    base = env.unwrapped
    assert base.config["lanes_count"] == 2
    assert base.config["action"]["type"] == "DiscreteMetaAction"
    assert base.config["vehicles_count"] == 20  # the id's own default
    env.reset(seed=0)
    assert base.vehicle.target_speeds.tolist() == [10, 20]
    assert len(base.road.network.graph["0"]["1"]) == 2


def test_another_action_type_replaces_the_default_one():
    env = gym.make("esc_gym/intersection-v0", config={"action": {"type": "ContinuousAction"}})
    # Merged, the default's {"lateral": False} would have left one dimension.
    assert env.action_space.shape == (2,)


def test_another_action_type_takes_no_key_of_the_default_one():
    action = {"type": "ContinuousAction", "target_speeds": [0, 9]}
    with pytest.raises(ValueError, match=r"'action'.: unknown key 'target_speeds'"):
        gym.make("esc_gym/intersection-v0", config={"action": action})


@pytest.mark.parametrize(
    "base_id", ["parking-ActionRepeat-v0", "parking-parked-v0", "lane-keeping-v0"]
)
def test_ids_that_take_no_config_get_it_all_the_same(base_id):
    stock = gym.make(base_id).unwrapped.config
    env = gym.make(
        f"esc_gym/{base_id}", config={"simulation_frequency": 20}, render_mode="rgb_array"
    )
    config = env.unwrapped.config
    assert config["simulation_frequency"] == 20
    for key in ("policy_frequency", "duration", "vehicles_count"):
        assert config.get(key) == stock.get(key)  # set by their __init__
    env.reset(seed=0)
    frame = env.render()
    assert frame.ndim == 3
    assert frame.std() > 0
    env.close()


def test_merge_config_leaves_the_default_alone():
    action = {"type": "DiscreteMetaAction", "lateral": True}
    default = {"action": dict(action), "lanes_count": 4}
    merged = merge_config(default, {"action": {"lateral": False}, "jerk_reward": -1})
    changed = {"type": "DiscreteMetaAction", "lateral": False}
    assert merged == {"action": changed, "lanes_count": 4, "jerk_reward": -1}
    other = {"type": "ContinuousAction"}
    assert merge_config(default, {"action": other})["action"] == other
    assert default == {"action": action, "lanes_count": 4}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vehicles_count": "abc"}, "'vehicles_count'.: expected a whole number from 0 to"),
        ({"vehicles_count": True}, "expected a whole number from 0 to 10000, got True"),
        ({"normalize_reward": 3}, "'normalize_reward'.: expected true or false, got 3"),
        ({"reward_speed_range": [20, 20]}, r"expected two rising numbers, got \[20, 20\]"),
        ({"vehicles_count": -3}, "expected a whole number from 0 to 10000, got -3"),
        ({"vehicles_count": 10**9}, "expected a whole number from 0 to 10000, got 1000000000"),
        ({"lanes_count": 2.5}, "expected a whole number from 1 to 10000, got 2.5"),
        ({"lanes_count": 0}, "expected a whole number from 1 to 10000, got 0"),
        ({"duration": "long"}, "'duration'.: expected a number of at least 0, got 'long'"),
        ({"duration": float("nan")}, "expected a number of at least 0, got nan"),
        ({"vehicles_density": 0}, "'vehicles_density'.: expected a number from 0.0001 to 1"),
        ({"vehicles_density": 1e-300}, "'vehicles_density'.: expected a number from 0.0001 to 1"),
        ({"policy_frequency": 0}, "'policy_frequency'.: expected a number above 0, at most 1"),
        ({"simulation_frequency": 1e9}, "expected a number above 0, at most 10000, got 1000000"),
        ({"reward_speed_range": [20]}, r"expected two rising numbers, got .20."),
        ({"collision_reward": float("nan")}, "'collision_reward'.: expected a number, got nan"),
        ({"jerk_reward": "much"}, "'jerk_reward'.: expected a number, got 'much'"),
        ({"initial_lane_id": 9}, "expected a whole number below 4, got 9"),
        ({"other_vehicles_type": 5}, "'other_vehicles_type'.: expected a class to import"),
        ({"other_vehicles_type": "my.Class"}, "expected a class to import.* got 'my.Class'"),
        ({"other_vehicles_type": "highway_env.No"}, "expected a class to import"),
        ([1], "config: expected a mapping"),
        ({"action": {"type": "Steering"}}, "expected one of ContinuousAction, .* got 'Steering'"),
        ({"action": {"typ": "ContinuousAction"}}, "unknown key 'typ'; did you mean 'type'"),
        (
            {"action": {"type": "ContinuousAction", "steering_rang": [-1, 1]}},
            "unknown key 'steering_rang'; did you mean 'steering_range'",
        ),
    ],
)
def test_numbers_in_a_configuration(changes, message):
    with pytest.raises(ValueError, match=message):
        gym.make("esc_gym/highway-v0", config=changes)


def test_bad_configuration():
    with pytest.raises(ValueError, match="unknown key 'lane_count'; did you mean 'lanes_count'"):
        gym.make("esc_gym/highway-v0", config={"lane_count": 3})
    with pytest.raises(ValueError, match="'colision_reward'; did you mean 'collision_reward'"):
        gym.make("esc_gym/highway-v0", config={"colision_reward": -3})
    with pytest.raises(TypeError, match="unexpected argument 'feature'; did you mean 'features'"):
        gym.make("esc_gym/highway-v0", feature=["x"])
    with pytest.raises(ValueError, match="has no effect here: esc_gym observes the set"):
        gym.make("esc_gym/highway-v0", config={"observation": {"type": "Kinematics"}})


def test_default_n_holds_all_vehicles():
    for base_id, config, n in [
        ("highway-v0", {}, 50),
        ("highway-v0", {"vehicles_count": 30}, 30),
        ("merge-generic-v0", {"vehicles_count": 9}, 11),
        ("racetrack-oval-v0", {"block_lane": True}, 9),
        ("parking-parked-v0", {}, 14),
        ("parking-v0", {"add_walls": False}, 1),
        ("lane-keeping-v0", {}, 1),
    ]:
        env = gym.make(f"esc_gym/{base_id}", config=config)
        assert env.observation_space["mask"].n == n, base_id


def test_a_lane_may_be_numpys_number():
    env = gym.make("esc_gym/highway-v0", config={"initial_lane_id": np.int64(2)})
    env.reset(seed=0)
    assert env.unwrapped.vehicle.lane_index[2] == 2
