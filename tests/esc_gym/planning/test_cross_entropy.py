"""Planning of continuous actions, beside the same draws in deep copies of stock environments."""

import numpy as np
import pytest

from esc_gym.planning import CrossEntropy, rollouts
from tests.esc_gym.planning.scenes import by_deep_copies, driven

RACETRACK = "esc_gym/racetrack-v0"
CONTINUOUS = [RACETRACK, "esc_gym/parking-v0"]


@pytest.mark.parametrize("env_id", CONTINUOUS)
def test_the_best_of_what_is_drawn_in_deep_copies(env_id):
    planner = CrossEntropy(horizon=5, samples=6, elites=2, iterations=1, hold=2, seed=4)
    envs, others = driven(env_id)
    dim = envs.single_action_space.shape[0]
    found = planner.actions(envs)
    firsts = set()
    for e, other in enumerate(others):
        rng = np.random.default_rng([4, 7 + e + 1, 3])  # of its seed, after three steps
        tried = np.clip(0.5 * rng.normal(size=(6, 3, dim)), -1, 1)
        tried[0] = 0
        plans = np.repeat(tried.astype(np.float32), 2, axis=1)[:, :5]
        returns, _ = by_deep_copies(other, plans, planner)
        np.testing.assert_array_equal(found[e], plans[np.argmax(returns), 0])
        firsts.add(int(np.argmax(returns)))
    assert firsts != {0}
    np.testing.assert_array_equal(planner.actions(envs, [1]), found[1:])


def test_more_iterations_find_more():
    """Returns of the plans' first action, held: those of later iterations are no worse."""
    envs, _ = driven(RACETRACK, 8)
    before = envs.snapshot()
    shared = {"horizon": 8, "hold": 8, "samples": 16, "elites": 4}
    returns = []
    for count in (1, 2, 5):
        held = np.repeat(CrossEntropy(iterations=count, **shared).actions(envs)[:, None], 8, axis=1)
        returns.append(rollouts(envs, range(8), held, 0.95, 10.0))
    assert envs.snapshot() == before
    assert (returns[1] >= returns[0]).all()
    assert (returns[2] >= returns[1]).all()
    assert (returns[2] > returns[0]).any()


def test_without_spread_the_middle_is_done():
    envs, _ = driven(RACETRACK)
    found = CrossEntropy(spread=0.0, horizon=3, samples=2, elites=1, iterations=2).actions(envs)
    assert found.dtype == envs.single_action_space.dtype
    np.testing.assert_array_equal(found, np.zeros((2, 1)))


def test_with_guesses_it_does_not_depend_on_what_cannot_be_seen():
    envs, _ = driven(RACETRACK)
    planner = CrossEntropy(horizon=6, samples=8, elites=2, iterations=2, knows="observed")
    found = planner.actions(envs)
    state = envs.engine.state
    for e, (n, _, _, ego) in enumerate(state.counts):
        others = np.delete(np.arange(n), ego)
        state.vehicles["target_speed"][e, others] = 1.0
    np.testing.assert_array_equal(planner.actions(envs), found)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"samples": 4}, "elites: expected at most the samples, 4, got 8"),
        ({"iterations": 0}, "iterations: expected at least 1, got 0"),
        ({"hold": 0}, "hold: expected at least 1, got 0"),
        ({"spread": -0.1}, "spread: expected at least 0, got -0.1"),
        ({"knows": "some"}, "knows: expected 'all' or 'observed', got 'some'"),
    ],
)
def test_bad_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        CrossEntropy(**arguments)


def test_meta_actions_are_refused():
    envs, _ = driven("esc_gym/highway-fast-v0", steps=0)
    with pytest.raises(ValueError, match="expected an environment with continuous actions, got"):
        CrossEntropy().actions(envs)
