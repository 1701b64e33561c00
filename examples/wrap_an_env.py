"""Observe highway-env's traffic as a set: two ways to make the environment."""

import gymnasium as gym

import esc_gym
from esc_gym import SetObservation

# By id: every single-agent environment of highway-env has one.
env = gym.make("esc_gym/merge-v1", perception_distance=100.0)
observation, info = env.reset(seed=0)
print(f"{len(esc_gym.ENV_IDS)} environments, among them {env.spec.id}")
print("shapes:", {name: value.shape for name, value in observation.items()})
print("vehicles within 100 m:", info["set"]["count"])

# By wrapper: around any highway-env environment that you already have.
env = SetObservation(
    gym.make("highway-fast-v0"), ranges={"x": (-100, 100), "y": (-12, 12)}, order="distance"
)
observation, info = env.reset(seed=0)
nearest = env.decode(observation)["vehicles"][0].round(1).tolist()
print("nearest vehicle:", dict(zip(env.set_spec.features, nearest, strict=True)))
for _ in range(5):
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    print(f"reward {reward:.2f}, set of {info['set']['count']}, ids {info['set']['ids']}")
    if terminated or truncated:
        break
