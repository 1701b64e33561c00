"""Looking ahead, beside the same plans in deep copies of what highway-env simulates."""

from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest

from esc_gym.planning import LookAhead, meta_actions, rollouts
from tests.esc_gym.vector.stock import batch, stock

IDS = ["esc_gym/highway-fast-v0", "esc_gym/merge-v0", "esc_gym/intersection-v0"]


def driven(env_id, count=2, steps=3, **arguments):
    """A batch in the middle of its first episodes, and stock environments in the same places."""
    envs = batch(env_id, count, {}, **arguments)
    envs.reset(seed=7)
    others = [stock(env_id, {}) for _ in range(count)]
    for seed, other in enumerate(others, 7):
        other.reset(seed=seed)
    for step in range(steps):
        action = step % envs.single_action_space.n
        envs.step(np.full(count, action))
        for other in others:
            other.step(action)
    return envs, others


def by_deep_copies(env, sequences, discount):
    """The returns of sequences of actions, each in a deep copy of ``env``."""
    returns = []
    for sequence in sequences:
        copy, total = deepcopy(env), 0.0
        for step, action in enumerate(sequence.tolist()):
            _, reward, terminated, truncated, _ = copy.step(action)
            total += discount**step * float(reward)
            if terminated or truncated:
                break
        returns.append(total)
    return returns


@pytest.mark.parametrize("env_id", IDS)
def test_values_are_those_of_deep_copies(env_id):
    planner = LookAhead(horizon=5, discount=0.9)
    envs, others = driven(env_id)
    plans = planner.sequences(envs)
    expected = [
        [max(by_deep_copies(other, of_one, planner.discount)) for of_one in plans]
        for other in others
    ]
    np.testing.assert_array_equal(planner.values(envs), expected)
    np.testing.assert_array_equal(
        planner.values(envs, [1, 0, -1]), [expected[i] for i in (1, 0, 1)]
    )


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_planning_leaves_the_batch_alone(mode):
    envs, _ = driven(IDS[0], autoreset_mode=mode)
    before = envs.snapshot()
    first = LookAhead().values(envs)
    assert envs.snapshot() == before
    np.testing.assert_array_equal(LookAhead().values(envs), first)
    assert envs.autoreset_mode.value == mode
    envs.step(np.zeros(2, int))


def test_sequences_are_each_action_then_a_continuation():
    envs, _ = driven(IDS[0], steps=0)
    plans = LookAhead(horizon=3).sequences(envs)
    numbers = meta_actions(envs)
    assert plans.shape == (5, 2, 3)
    for name, action in numbers.items():
        for continuation, after in zip(plans[action], ("IDLE", "SLOWER"), strict=True):
            assert continuation.tolist() == [numbers[name], numbers[after], numbers[after]]


def test_an_ended_episode_is_worth_nothing():
    envs = batch(IDS[0], 2, {"duration": 1})
    envs.reset(seed=0)
    envs.step(np.ones(2, int))  # IDLE, to the end of both episodes
    np.testing.assert_array_equal(LookAhead().values(envs), np.zeros((2, 5)))
    np.testing.assert_array_equal(LookAhead().actions(envs), [1, 1])


def test_nothing_is_earned_after_the_end():
    envs = batch(IDS[0], 1, {"duration": 2})
    envs.reset(seed=0)
    longer, whole = (rollouts(envs, [0], np.ones((1, steps), int)) for steps in (6, 2))
    np.testing.assert_array_equal(longer, whole)


def test_the_best_action_is_taken_and_idle_among_equals(monkeypatch):
    envs, _ = driven(IDS[0], steps=0)
    values = np.array([[3.0, 3.0, 1.0, 0.0, 0.0], [0.0, 1.0, 2.0, 2.0, 0.0]])
    monkeypatch.setattr(LookAhead, "values", lambda self, envs: values)
    np.testing.assert_array_equal(LookAhead().actions(envs), [1, 2])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "horizon: expected at least 1 step, got 0"),
        ({"discount": 1.5}, "discount: expected a number from 0 to 1, got 1.5"),
        ({"continuations": ()}, "continuations: expected at least one name of a meta-action"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        LookAhead(**arguments)


def test_what_cannot_be_planned_is_refused():
    envs, _ = driven(IDS[2], steps=0)
    with pytest.raises(ValueError, match="expected SLOWER, IDLE, FASTER, got 'LANE_LEFT'"):
        LookAhead(continuations=("IDLE", "LANE_LEFT")).values(envs)
    with pytest.raises(ValueError, match="expected the number of an environment, 0 to 1, got 2"):
        LookAhead().values(envs, [0, 2])
    racetrack = gym.make_vec("esc_gym/racetrack-v0", 1)
    racetrack.reset(seed=0)
    with pytest.raises(ValueError, match="expected an environment with meta-actions, got"):
        LookAhead().values(racetrack)
    slow = gym.make_vec("esc_gym/highway-fast-v0", 1, accelerate=False)
    slow.reset(seed=0)
    with pytest.raises(ValueError, match="which does not simulate this: accelerate=False"):
        LookAhead().values(slow)
