"""Parking's goal in keys of its own, as SB3's HER takes it."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.env_checker import check_env

from esc_gym import ESCExtractor, SetObservation, SetVecEnv
from esc_gym.extractors import SetExtractor, goal_ahead
from esc_gym.fastsim import report
from esc_gym.registration import make
from tests.esc_gym.vector.stock import compare

IDS = ["parking-v0", "parking-parked-v0", "parking-ActionRepeat-v0"]


@pytest.mark.parametrize("base_id", IDS)
@pytest.mark.parametrize("accelerate", [False, True])
def test_the_goals_and_rewards_of_highway_env(base_id, accelerate):
    ours = gym.make(f"esc_gym/{base_id}", goal=True, accelerate=accelerate)
    stock = gym.make(base_id)
    reward_of = ours.get_wrapper_attr("compute_reward")
    mine, _ = ours.reset(seed=3)
    theirs, _ = stock.reset(seed=3)
    rng, penalty = np.random.default_rng(0), stock.unwrapped.config["collision_reward"]
    for _ in range(30):
        for name in ("achieved_goal", "desired_goal"):
            assert mine[name].tobytes() == theirs[name].tobytes()
        action = rng.uniform(-1, 1, 2).astype(np.float32)
        mine, reward, terminated, _, info = ours.step(action)
        theirs, expected, *_ = stock.step(action)
        assert reward == expected
        goals = mine["achieved_goal"], mine["desired_goal"]
        assert reward == reward_of(*goals, {}) + penalty * info["crashed"]
        if terminated:
            mine, _ = ours.reset()
            theirs, _ = stock.reset()


@pytest.mark.parametrize("base_id", IDS)
def test_a_batch_as_stock(base_id):
    compare(f"esc_gym/{base_id}", seeds=range(4), steps=40, threads=2, disturbed=True, goal=True)


def test_the_ego_sees_the_goal_as_its_features_say():
    names = ["goal_x", "goal_y", "goal_cos_h", "goal_sin_h"]
    with_features = gym.make("esc_gym/parking-v0", ego_features=names)
    with_goal = gym.make("esc_gym/parking-v0", goal=True)
    rng = np.random.default_rng(0)
    for seed in range(5):
        ego = with_features.reset(seed=seed)[0]["ego"]
        seen = with_goal.reset(seed=seed)[0]
        for _ in range(5):
            goals = (torch.as_tensor(seen[f"{kind}_goal"]) for kind in ("achieved", "desired"))
            ahead = goal_ahead(*goals).numpy() * [0.2, 0.2, 1, 1]  # 20 m is 1 there
            np.testing.assert_allclose(ahead, ego, atol=1e-6)
            action = rng.uniform(-1, 1, 2).astype(np.float32)
            ego, seen = with_features.step(action)[0]["ego"], with_goal.step(action)[0]


def test_the_extractor_reads_the_desired_goal():
    env = gym.make("esc_gym/parking-v0", goal=True)
    extractor = SetExtractor(env.observation_space)
    seen = {
        name: torch.as_tensor(part[None]).float() for name, part in env.reset(seed=0)[0].items()
    }
    moved = {**seen, "desired_goal": seen["desired_goal"] + 0.1}
    assert extractor(seen).shape == (1, extractor.features_dim)
    assert not torch.equal(extractor(seen), extractor(moved))


@pytest.mark.parametrize("base_id", IDS)
def test_sb3_takes_it_for_a_goal_environment(base_id):
    # Without Gymnasium's own wrappers, which pass on no methods: the checker looks for one.
    check_env(make(base_id, goal=True), warn=False)


@pytest.mark.parametrize("engine", [True, False])
def test_hindsight_on_a_batch(engine):
    envs = SetVecEnv("parking-v0", 3, goal=True, config={"duration": 2}, accelerate=engine)
    assert envs.envs.report().engine == engine
    model = SAC(
        "MultiInputPolicy", envs, replay_buffer_class=HerReplayBuffer, learning_starts=60,
        batch_size=32, policy_kwargs={"features_extractor_class": ESCExtractor, "net_arch": [8]},
    )  # fmt: skip
    model.learn(90)
    buffer = model.replay_buffer
    assert isinstance(buffer, HerReplayBuffer)
    sample = buffer.sample(500)
    reached, wanted = (
        sample.next_observations["achieved_goal"],
        sample.observations["desired_goal"],
    )
    expected = gym.make("parking-v0").unwrapped.compute_reward(reached.numpy(), wanted.numpy(), {})
    crashes = sample.rewards.numpy()[:, 0] < expected - 1
    np.testing.assert_allclose(sample.rewards.numpy()[~crashes, 0], expected[~crashes], atol=1e-6)
    assert (expected == 0).any()  # where the goal is the state itself


def test_without_goals_there_is_no_goal_environment():
    env = gym.make("esc_gym/parking-v0")
    assert not hasattr(env.unwrapped, "compute_reward")
    for batch in (SetVecEnv("parking-v0", 2), SetVecEnv("parking-v0", 2, accelerate=False)):
        assert not hasattr(batch.envs, "compute_reward")


def test_mistakes():
    with pytest.raises(ValueError, match="goal: expected a parking environment, got HighwayEnv"):
        gym.make("esc_gym/highway-v0", goal=True)
    with pytest.raises(ValueError, match="none of the goal with goal=True, got goal_x, goal_y"):
        gym.make("esc_gym/parking-v0", goal=True, ego_features=["speed", "goal_x", "goal_y"])


def test_on_highway_envs_own_environment():
    env = SetObservation(gym.make("parking-v0"), goal=True)
    observation, _ = env.reset(seed=0)
    expected, _ = gym.make("parking-v0").reset(seed=0)
    np.testing.assert_array_equal(observation["desired_goal"], expected["desired_goal"])
    env.step(env.action_space.sample())
    assert report(env).stock == {}
