"""highway-env at compiled speed, with its own observation: the same drive, to the last bit."""

import time

import gymnasium as gym
import highway_env  # noqa: F401

import esc_gym


def drive(env, steps=12):
    """Seconds of a step, and where the ego is at the end."""
    env.reset(seed=0)
    start = time.perf_counter()
    for _ in range(steps):
        env.step(1)
    return (time.perf_counter() - start) / steps, env.unwrapped.vehicle.position.tolist()


stock = gym.make("highway-fast-v0", config={"vehicles_density": 0.5})
fast = esc_gym.accelerate(gym.make("highway-fast-v0", config={"vehicles_density": 0.5}))
drive(fast, 1)  # the first step loads the compiled code, the first one ever compiles it
(seconds, position), (fast_seconds, fast_position) = drive(stock), drive(fast)
print(f"stock {1e3 * seconds:.1f} ms, accelerated {1e3 * fast_seconds:.1f} ms per step")
print("most of what is left is highway-env's own observation; esc_gym/highway-fast-v0 has no such")
assert position == fast_position
print(esc_gym.fastsim.report(fast))

# What the compiled code does not know, highway-env's own code simulates: the same drive again.
fast.unwrapped.config["show_trajectories"] = True
assert drive(fast)[1] == position
print(esc_gym.fastsim.report(fast))
