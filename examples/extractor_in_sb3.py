"""ESC in Stable-Baselines3 code that you already have: one import and one policy_kwargs."""

import sys

import gymnasium as gym
from stable_baselines3 import PPO

from esc_gym import ESCExtractor  # or FPExtractor, AttentionExtractor, ...

steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
env = gym.make("esc_gym/highway-fast-v0", ranges={"x": (-100, 100), "y": (-12, 12)})
model = PPO(
    "MultiInputPolicy",
    env,
    n_steps=min(512, steps),
    batch_size=32,
    gamma=0.95,
    policy_kwargs={
        "features_extractor_class": ESCExtractor,
        "features_extractor_kwargs": {"hidden": (64, 64), "scale": 0.1},
        "net_arch": [64, 64],
    },
    seed=0,
    verbose=1,
)
model.learn(steps)
model.save("esc_ppo")

model = PPO.load("esc_ppo")  # nothing to register: esc_gym only has to be installed
observation, _ = env.reset(seed=1)
action, _ = model.predict(observation, deterministic=True)
print("action for the first observation:", action)
