"""Which meta-actions are available: read off the road by hand, and taken by sb3-contrib."""

import gymnasium as gym
import numpy as np
import pytest
from sb3_contrib import MaskablePPO
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

import esc_gym  # noqa: F401  (registers the ids)
from esc_gym import ESCExtractor

NAMES = {
    (True, True): ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER"),
    (False, True): ("SLOWER", "IDLE", "FASTER"),
    (True, False): ("LANE_LEFT", "IDLE", "LANE_RIGHT"),
}
ROAD = {"vehicles_count": 6, "lanes_count": 3, "duration": 40}


def by_hand(vehicle, names, lowest, highest):
    """highway-env's lanes are 4 m wide, and the leftmost one has its middle at y = 0."""
    lane = round(vehicle.position[1] / 4)
    rule = {
        "IDLE": True, "LANE_LEFT": lane > 0, "LANE_RIGHT": lane < ROAD["lanes_count"] - 1,
        "SLOWER": vehicle.target_speed > lowest, "FASTER": vehicle.target_speed < highest,
    }  # fmt: skip
    return [rule[name] for name in names]


@pytest.mark.parametrize("accelerate", [True, False])
@pytest.mark.parametrize(("lateral", "longitudinal"), NAMES)
def test_masks_say_what_the_road_and_the_target_speeds_allow(lateral, longitudinal, accelerate):
    action = {"lateral": lateral, "longitudinal": longitudinal, "target_speeds": [10, 15, 20]}
    env = gym.make(
        "esc_gym/highway-fast-v0", config={**ROAD, "action": action}, accelerate=accelerate
    )
    names, seen = NAMES[lateral, longitudinal], []
    generator = np.random.default_rng(0)
    for seed in range(3):
        env.reset(seed=seed)
        ended = False
        while not ended:
            masks = get_action_masks(env)
            assert masks.dtype == bool
            assert masks.tolist() == by_hand(env.unwrapped.vehicle, names, 10, 20)
            seen.append(masks)
            _, _, terminated, truncated, _ = env.step(generator.integers(len(names)))
            ended = terminated or truncated
    both = np.ptp(np.array(seen).astype(int), axis=0)
    assert both.tolist() == [name != "IDLE" for name in names]  # each was on, and was off


def test_the_ramp_of_a_merge_is_not_available():
    """It lies to the right of the ego's lane, and highway-env forbids to change to it."""
    env = gym.make("esc_gym/merge-v0")
    env.reset(seed=0)
    for _ in range(12):
        assert get_action_masks(env)[:3].tolist() == [True, True, False]
        env.step(4)
    assert env.unwrapped.vehicle.lane_index == ("b", "c", 1)  # beside the ramp, ("b", "c", 2)
    assert get_action_masks(env)[:3].tolist() == [True, True, False]


@pytest.mark.parametrize(("vec_env", "count"), [(DummyVecEnv, 2), (SubprocVecEnv, 1)])
def test_maskable_ppo_takes_nothing_that_is_not_available(vec_env, count):
    envs = make_vec_env("esc_gym:esc_gym/highway-fast-v0", count, vec_env_cls=vec_env)  # Monitors
    assert is_masking_supported(envs)
    model = MaskablePPO(
        "MultiInputPolicy", envs, n_steps=64 // count, batch_size=32, n_epochs=1, seed=0,
        device="cpu", policy_kwargs={"features_extractor_class": ESCExtractor},
    )  # fmt: skip
    model.learn(64)
    envs.close()
    buffer = model.rollout_buffer
    masks = buffer.action_masks.reshape(64, 5).astype(bool)
    assert not masks.all()
    assert masks[np.arange(64), buffer.actions.reshape(64).astype(int)].all()


def test_maskable_ppo_takes_an_id_as_it_is():
    env = gym.make("esc_gym/highway-v0")
    MaskablePPO(
        "MultiInputPolicy", env, n_steps=8, batch_size=8, n_epochs=1, device="cpu",
        policy_kwargs={"features_extractor_class": ESCExtractor},
    ).learn(8)  # fmt: skip


@pytest.mark.parametrize("kind", ["ContinuousAction", "DiscreteAction"])
def test_throttle_and_steering_have_no_masks(kind):
    env = gym.make("esc_gym/highway-fast-v0", config={"action": {"type": kind}})
    env.reset(seed=0)
    with pytest.raises(ValueError, match=f"expected meta-actions, got {kind}, whose actions are"):
        get_action_masks(env)
