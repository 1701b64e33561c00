"""What a batch refuses, in the engine and one by one; nothing moves then."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from esc_gym import SetVecEnv
from esc_gym.vector import SetVectorEnv

CONFIG = {"vehicles_count": 4, "duration": 5}
HERE = np.array([True, False])


def batch(accelerate: bool = True, **arguments: Any) -> SetVectorEnv:
    return SetVectorEnv("highway-fast-v0", 2, CONFIG, accelerate=accelerate, **arguments)


BEFORE: dict[str, Callable[[Any], object]] = {
    "step": lambda envs: envs.step(np.ones(2, int)),
    "snapshot": lambda envs: envs.snapshot(),
    "fork": lambda envs: envs.fork([0]),
    "keep": lambda envs: envs.keep([0]),
    "materialise": lambda envs: envs.materialise(0),
    "measure": lambda envs: envs.measure(),
    "rest": lambda envs: envs.rest(HERE),
}


@pytest.mark.parametrize("name", BEFORE)
def test_nothing_before_the_first_reset(name):
    envs = batch()
    with pytest.raises(gym.error.ResetNeeded, match="environment 0 was never reset"):
        BEFORE[name](envs)
    envs.reset(seed=0, options={"reset_mask": HERE})
    with pytest.raises(gym.error.ResetNeeded, match="environment 1 was never reset"):
        BEFORE[name](envs)
    envs.reset(seed=0, options={"reset_mask": ~HERE})
    BEFORE[name](envs)


def test_no_step_before_the_first_reset_one_by_one_and_in_sb3():
    with pytest.raises(gym.error.ResetNeeded):
        batch(accelerate=False).step(np.ones(2, int))
    with pytest.raises(gym.error.ResetNeeded):
        SetVecEnv("highway-fast-v0", 2, config=CONFIG).step(np.ones(2, int))


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        ([1, 9], "expected 0 to 4, got 9"),
        ([1], r"expected shape \(2,\), got \(1,\)"),
        ([1.0, 1.5], "expected whole numbers, got float64"),
        ([1.0, np.nan], "expected whole numbers"),
        ([[1], [1, 2]], "expected one array"),
    ],
)
def test_bad_actions_move_nobody_one_by_one_either(actions, message):
    envs = batch(accelerate=False)
    envs.reset(seed=0)
    places = [env.unwrapped.vehicle.position.tolist() for env in envs._envs.envs]
    with pytest.raises(ValueError, match=message):
        envs.step(actions)
    assert places == [env.unwrapped.vehicle.position.tolist() for env in envs._envs.envs]


REFUSED: dict[str, tuple[Callable[[Any], object], str]] = {
    "an index that is no number": (lambda envs: envs.fork([1.5]), "number of an environment"),
    "an index that is a truth": (lambda envs: envs.fork([True]), "number of an environment"),
    "an index too large": (lambda envs: envs.materialise(2), "0 to 1, got 2"),
    "a text": (lambda envs: envs.fork("a"), "number of an environment"),
    "no indices": (lambda envs: envs.fork([]), "at least one environment"),
    "nothing": (lambda envs: envs.fork(None), "number of an environment"),
    "a mask of integers": (lambda envs: envs.rest(np.array([1, 0])), r"mask: expected a bool"),
    "no mask": (lambda envs: envs.rest(None), "mask: expected a bool array"),
    "a seed in words": (lambda envs: envs.reset(seed="12"), "seed: expected whole numbers"),
    "half a seed": (lambda envs: envs.reset(seed=[0, 1.5]), "seed: expected whole numbers"),
    "a seed that is a truth": (lambda envs: envs.reset(seed=True), "seed: expected whole numbers"),
    "a seed below 0": (lambda envs: envs.reset(seed=[0, -1]), "seed: expected whole numbers"),
    "a snapshot of nothing": (lambda envs: envs.restore(None), "expected bytes, got NoneType"),
    "a snapshot of numbers": (
        lambda envs: envs.restore(np.zeros(9, np.uint8)),
        "snapshot: expected bytes, got ndarray",
    ),
    "a seed too many": (lambda envs: envs.reset(seed=[0, 1, 2]), "expected 2 seeds"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_and_unchanged(name):
    call, message = REFUSED[name]
    envs = batch()
    envs.reset(seed=0)
    before = envs.snapshot()
    with pytest.raises(ValueError, match=message):
        call(envs)
    assert envs.snapshot() == before


@pytest.mark.parametrize("accelerate", [True, False])
def test_after_close(accelerate):
    envs = batch(accelerate)
    envs.reset(seed=0)
    data = envs.snapshot() if accelerate else b""
    envs.close()
    calls = (
        lambda: envs.step(np.ones(2, int)), envs.reset, envs.snapshot, lambda: envs.restore(data),
        lambda: envs.fork([0]), lambda: envs.materialise(0), lambda: envs.rest(HERE), envs.measure,
        lambda: envs.keep([0]), lambda: envs.go_back([0], ()),
    )  # fmt: skip
    for call in calls:
        with pytest.raises(gym.error.ClosedEnvironmentError, match="was closed"):
            call()


@pytest.mark.parametrize("accelerate", [True, False])
def test_after_close_in_sb3(accelerate):
    envs = SetVecEnv("highway-fast-v0", 2, accelerate=accelerate)
    envs.reset()
    envs.close()
    for call in (envs.reset, lambda: envs.step(np.zeros(2, int))):
        with pytest.raises(gym.error.ClosedEnvironmentError, match="was closed"):
            call()


def test_who_is_told_of_vehicles_left_out():
    """The line that called ``reset``, not one of ours."""
    envs = batch(max_vehicles=1)
    with pytest.warns(UserWarning, match="the 1 nearest are kept") as warned:
        envs.reset(seed=0)
    assert warned[0].filename == __file__


def test_bad_limits_and_modes():
    with pytest.raises(ValueError, match="max_episode_steps: expected a whole number"):
        batch(max_episode_steps=0)
    with pytest.raises(ValueError, match="render_mode: expected None or 'rgb_array', got 'ansi'"):
        batch(render_mode="ansi")


def test_a_materialised_environment_can_be_looked_at():
    envs = batch()
    envs.reset(seed=0)
    assert envs.materialise(0).render().ndim == 3
