"""SetObservation against an independent reading of the simulator's road."""

from __future__ import annotations

import copy
import doctest
import pickle

import gymnasium as gym
import highway_env  # noqa: F401
import numpy as np
import pytest
from highway_env.envs.common.observation import observation_factory
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import Landmark, Obstacle

import esc_gym
from esc_gym import SetObservation
from tests.esc_gym.road import assert_same_set, expected_set, observe


def place(env, x=20.0, y=0.0, speed=0.0, heading=0.0, cls=IDMVehicle):
    """Add an object at a place relative to the ego."""
    base = env.unwrapped
    other = cls(base.road, base.vehicle.position + np.array([x, y]), heading=heading, speed=speed)
    (base.road.objects if cls in (Obstacle, Landmark) else base.road.vehicles).append(other)
    return other


def alone(env):
    env.unwrapped.road.vehicles[:] = [env.unwrapped.vehicle]
    env.unwrapped.road.objects.clear()


@pytest.fixture
def env():
    env = gym.make("esc_gym/highway-fast-v0")
    env.reset(seed=0)
    yield env
    env.close()


@pytest.mark.parametrize("frame", ["world", "ego"])
@pytest.mark.parametrize("base_id", ["merge-v0", "intersection-v0", "roundabout-v0", "parking-v0"])
def test_set_equals_the_road(base_id, frame):
    env = gym.make(f"esc_gym/{base_id}", frame=frame)
    seen = []
    # Intersections clear and spawn vehicles after observing: compare at the instant of observing.
    kind = env.unwrapped.observation_type
    original = kind.observe
    kind.observe = lambda: (seen.append(expected_set(env, 200.0, frame)), original())[1]
    for seed in range(2):
        observation, info = env.reset(seed=seed)
        for _ in range(6):
            rows = env.get_wrapper_attr("decode")(observation)["vehicles"]
            assert_same_set(rows[: info["set"]["count"]], seen[-1])
            observation, _, terminated, _, info = env.step(env.action_space.sample())
            if terminated:
                break


def test_distance_behind_and_landmarks(env):
    alone(env)
    place(env, x=-150.0)
    place(env, x=199.9)
    place(env, x=200.1)
    place(env, x=150.0, y=150.0)
    place(env, x=30.0, cls=Obstacle)
    place(env, x=10.0, cls=Landmark)
    rows = env.get_wrapper_attr("decode")(observe(env))["vehicles"][:3]
    assert rows[:, 0] == pytest.approx([-150.0, 199.9, 30.0], abs=1e-4)
    assert rows[:, 6].tolist() == [0.0, 0.0, 1.0]
    info = env.unwrapped.observation_type.info
    assert (info["count"], info["overflow"], len(set(info["ids"]))) == (3, 0, 3)


def test_stock_kinematics_agrees(env):
    """Same numbers as highway-env's own observation where both see a vehicle."""
    stock = observation_factory(
        env.unwrapped,
        {"type": "Kinematics", "vehicles_count": 30, "see_behind": True, "normalize": False,
         "features": ["presence", "x", "y", "vx", "vy", "cos_h", "sin_h"]},
    )  # fmt: skip
    for action in (1, 0, 3):
        observation, *_ = env.step(action)
        expected = stock.observe()[1:]
        expected = expected[expected[:, 0] == 1][:, 1:]
        count = int(observation["mask"].sum())
        assert count > 0
        rows = env.get_wrapper_attr("decode")(observation)["vehicles"][:count, :6]
        assert_same_set(rows, expected)


def test_empty_one_full_and_duplicates(env):
    alone(env)
    observation = observe(env)
    assert not observation["vehicles"].any()
    assert not observation["mask"].any()
    place(env, x=20.0)
    place(env, x=20.0)
    observation = observe(env)
    assert observation["mask"].tolist() == [1, 1] + [0] * 18
    assert (observation["vehicles"][0] == observation["vehicles"][1]).all()
    for i in range(18):
        place(env, x=5.0 * i)
    assert observe(env)["mask"].all()


def test_empty_virtual():
    env = gym.make("esc_gym/highway-fast-v0", empty="virtual", perception_distance=100.0)
    env.reset(seed=0)
    alone(env)
    observation = observe(env)
    assert observation in env.observation_space
    row = env.get_wrapper_attr("decode")(observation)["vehicles"][0]
    assert row == pytest.approx([100, 0, 0, 0, 1, 0, 0], abs=1e-4)
    assert observation["mask"].sum() == 1
    assert env.unwrapped.observation_type.info["count"] == 0


def test_overflow_keeps_the_nearest_and_says_so():
    env = gym.make("esc_gym/highway-fast-v0", max_vehicles=2)
    kind = env.unwrapped.observation_type
    with pytest.warns(UserWarning, match=r"8 vehicles within 200 m, but max_vehicles=2"):
        env.reset(seed=0)
    alone(env)
    for x in (50.0, -10.0, 90.0, 30.0):
        place(env, x=x)
    observation = observe(env)  # said once
    rows = env.get_wrapper_attr("decode")(observation)["vehicles"]
    assert rows[:, 0] == pytest.approx([-10.0, 30.0], abs=1e-4)  # the nearest, in road order
    assert (kind.info["count"], kind.info["overflow"], len(kind.info["ids"])) == (4, 2, 2)


def test_overflow_error():
    env = gym.make(
        "esc_gym/highway-fast-v0", max_vehicles=1, perception_distance=1.0, on_overflow="error"
    )
    env.reset(seed=0)
    place(env, x=0.1)
    place(env, x=0.2)
    with pytest.raises(OverflowError, match="Raise max_vehicles to 2"):
        observe(env)


def test_order_distance_and_shuffled(env):
    near_first = gym.make("esc_gym/highway-fast-v0", order="distance")
    observation, _ = near_first.reset(seed=5)
    rows = near_first.get_wrapper_attr("decode")(observation)["vehicles"]
    rows = rows[observation["mask"] == 1]
    distances = np.hypot(rows[:, 0], rows[:, 1])
    assert (np.diff(distances) >= 0).all()

    shuffled = gym.make("esc_gym/highway-fast-v0", order="shuffled")
    road = gym.make("esc_gym/highway-fast-v0")
    orders = set()
    a, info_a = shuffled.reset(seed=5)
    b, info_b = road.reset(seed=5)
    for _ in range(4):
        assert sorted(map(tuple, a["vehicles"])) == sorted(map(tuple, b["vehicles"]))
        ids = info_a["set"]["ids"]
        orders.add(tuple(np.argsort(ids)))
        if len(ids) > 3 and sorted(ids) != list(ids):
            orders.add("permuted")
        for i, j in enumerate(info_b["set"]["ids"]):
            assert (a["vehicles"][ids.index(j)] == b["vehicles"][i]).all()
        a, *_, info_a = shuffled.step(1)
        b, *_, info_b = road.step(1)
    assert "permuted" in orders
    state = "np_random"
    assert getattr(shuffled.unwrapped, state).bit_generator.state == (
        getattr(road.unwrapped, state).bit_generator.state
    )


def test_shuffle_is_reproducible_by_seed():
    envs = [gym.make("esc_gym/highway-fast-v0", order="shuffled") for _ in range(2)]
    rollouts = []
    for env in envs:
        _, info = env.reset(seed=11)
        ids = [info["set"]["ids"]]
        for _ in range(3):
            *_, info = env.step(1)
            ids.append(info["set"]["ids"])
        rollouts.append(ids)
    assert rollouts[0] == rollouts[1]


def test_ids_follow_vehicles(env):
    env.reset(seed=2)
    base, seen = env.unwrapped, {}
    for _ in range(5):
        rows = env.get_wrapper_attr("decode")(observe(env))["vehicles"]
        for row, number in zip(rows, base.observation_type.info["ids"], strict=False):
            nearest = min(
                base.road.vehicles,
                key=lambda v: np.abs(v.position - base.vehicle.position - row[:2]).sum(),
            )
            assert seen.setdefault(number, nearest) is nearest
        env.step(1)
    assert len(seen) > 3


def test_ranges_scale_without_clipping():
    env = gym.make("esc_gym/highway-fast-v0", ranges={"x": (-50, 50), "speed": (0, 30)})
    env.reset(seed=0)
    alone(env)
    place(env, x=150.0)
    place(env, x=-25.0)
    observation = observe(env)
    assert observation["vehicles"][:2, 0] == pytest.approx([3.0, -0.5], abs=1e-5)
    assert observation in env.observation_space
    assert env.observation_space["vehicles"].high[0, 0] == pytest.approx(4.0)
    speed = env.unwrapped.vehicle.speed
    assert observation["ego"][0] == pytest.approx(speed / 15 - 1, abs=1e-6)
    assert env.get_wrapper_attr("decode")(observation)["ego"][0] == pytest.approx(speed, abs=1e-4)


def test_decode_batches(env):
    observation, _ = env.reset(seed=0)
    decode = env.get_wrapper_attr("decode")
    batch = {key: np.stack([value, value]) for key, value in observation.items()}
    for key, value in decode(observation).items():
        assert (decode(batch)[key] == value).all()
    assert not decode(observation)["vehicles"][observation["mask"] == 0].any()


def rollout(env, steps=3, seed=None):
    observations = []
    for _ in range(steps):
        observation, *_ = env.step(1)
        observations.append(np.concatenate([observation["ego"], observation["vehicles"].ravel()]))
    return np.array(observations)


def test_pickle_and_deepcopy_in_mid_episode():
    env = gym.make("esc_gym/intersection-v0", order="shuffled")
    env.reset(seed=0)
    env.step(1)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    expected = rollout(env)
    for other in copies:
        assert other.unwrapped.observation_type.env is other.unwrapped
        assert (rollout(other) == expected).all()
        other.reset(seed=1)
        assert other.unwrapped.observation_type.env is other.unwrapped


def test_spec_round_trip_and_additional_wrappers():
    env = gym.make("esc_gym/highway-fast-v0", max_vehicles=7, config={"lanes_count": 2})
    again = gym.make(env.spec)
    assert again.observation_space == env.observation_space
    assert again.unwrapped.config["lanes_count"] == 2
    assert gym.make(gym.envs.registration.EnvSpec.from_json(env.spec.to_json())).observation_space

    wrapped = SetObservation(gym.make("highway-fast-v0"), max_vehicles=4)
    assert gym.make(wrapped.spec).observation_space == wrapped.observation_space

    gym.register(
        "set-highway-v0",
        entry_point="highway_env.envs.highway_env:HighwayEnvFast",
        additional_wrappers=(SetObservation.wrapper_spec(max_vehicles=3),),
    )
    try:
        assert gym.make("set-highway-v0").observation_space["mask"].n == 3
    finally:
        del gym.registry["set-highway-v0"]


@pytest.mark.parametrize("mode", ["sync", "async"])
def test_make_vec(mode):
    envs = gym.make_vec("esc_gym/merge-v0", num_envs=2, vectorization_mode=mode)
    observations, infos = envs.reset(seed=0)
    assert observations["vehicles"].shape == (2, 5, 7)
    observations, *_, infos = envs.step(np.array([1, 1]))
    assert infos["set"]["count"].tolist() == observations["mask"].sum(axis=1).tolist()
    envs.close()


def test_wrapping_again_replaces_the_observation(env):
    again = SetObservation(env, max_vehicles=3, perception_distance=30.0)
    observation, info = again.reset(seed=0)
    assert observation in again.observation_space
    assert info["set"]["count"] == len(expected_set(again, 30.0, "world"))


def test_speed_range_widens_the_scale():
    action = {"type": "ContinuousAction", "speed_range": [-10, 60]}
    env = gym.make("esc_gym/highway-fast-v0", config={"action": action})
    env.reset(seed=0)
    env.unwrapped.vehicle.speed = 60.0
    observation = observe(env)
    assert env.get_wrapper_attr("decode")(observation)["ego"][0] == pytest.approx(60.0, abs=1e-4)
    assert observation in env.observation_space


BAD = [
    ({"max_vehicles": 0}, "max_vehicles: expected a whole number of at least 1, got 0"),
    ({"max_vehicles": 2.5}, "expected a whole number"),
    ({"max_vehicles": True}, "expected a whole number"),
    ({"features": ["x", "colour"]}, r"got \['colour'\]"),
    ({"features": []}, "expected distinct names"),
    ({"features": "vx"}, "features: expected a sequence of names, got 'vx'"),
    ({"ego_features": "speed"}, "ego_features: expected a sequence of names, got 'speed'"),
    ({"ego_features": []}, "expected distinct names"),
    ({"features": ["x", "x"]}, "expected distinct names"),
    ({"ego_features": ["goal_x"]}, "does not exist in HighwayEnvFast"),
    ({"perception_distance": -1.0}, "expected a positive finite number"),
    ({"perception_distance": float("nan")}, "expected a positive finite number"),
    ({"order": "sorted"}, r"order: expected one of \('road', 'shuffled', 'distance'\)"),
    ({"frame": "polar"}, "frame: expected one of"),
    ({"empty": "none"}, "empty: expected one of"),
    ({"on_overflow": "drop"}, "on_overflow: expected one of"),
    ({"ranges": {"z": (0, 1)}}, "got 'z'"),
    ({"ranges": {"x": (1, 1)}}, r"expected \(low, high\)"),
]


@pytest.mark.parametrize(("arguments", "message"), BAD)
def test_bad_arguments(arguments, message):
    with pytest.raises(ValueError, match=message):
        SetObservation(gym.make("highway-fast-v0"), **arguments)


def test_wrong_environments():
    with pytest.raises(TypeError, match="expected a highway-env environment, got CartPoleEnv"):
        SetObservation(gym.make("CartPole-v1"))
    with pytest.raises(ValueError, match="expected one controlled vehicle"):
        SetObservation(gym.make("intersection-multi-agent-v0"))
    flat = gym.wrappers.FlattenObservation(gym.make("highway-fast-v0"))
    with pytest.raises(ValueError, match="Apply SetObservation first"):
        SetObservation(flat)


def test_the_example_in_the_docstring():
    assert doctest.testmod(esc_gym.observation).failed == 0
