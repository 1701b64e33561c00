"""Single environments go back to a state that was kept, and on from there."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest

from esc_gym.registration import ENV_IDS

FAST = "esc_gym/highway-fast-v0"


def batch(env_id=FAST, count=3, **arguments):
    made = gym.make_vec(env_id, count, vectorization_mode="vector_entry_point",
                        autoreset_mode="NextStep", **arguments)  # fmt: skip
    return made.unwrapped


def drawn(envs, seed):
    space = envs.single_action_space
    space.seed(seed)
    return np.array([space.sample() for _ in range(envs.num_envs)])


@pytest.mark.parametrize("env_id", sorted(ENV_IDS))
def test_as_a_fork_that_was_made_then(env_id):
    """Every id: also where highway-env observes before a step has done all that it does."""
    envs = batch(env_id, order="shuffled")
    if not envs.engine:
        pytest.skip(envs.report().reason)
    envs.reset(seed=4)
    envs.step(drawn(envs, 0))
    truth, kept = envs.fork([2, 0]), envs.keep([2, 0])
    seen = truth.engine.now.seen.parts()
    for i in range(5):  # over the end of episodes, and with others measured
        envs.step(drawn(envs, i))
        envs.measure(collisions=True)
    observation = envs.go_back([1, 2], kept)
    for name, part in observation.items():
        np.testing.assert_array_equal(part[[1, 2]], seen[name])
    measured, wanted = envs.measure(collisions=True), truth.measure(collisions=True)
    for part, there in zip(measured, wanted, strict=True):
        np.testing.assert_array_equal(part[[1, 2]], there)
    envs.engine.state.generators[[1, 2]] = truth.engine.state.generators
    for i in range(5):
        actions = drawn(truth, i)
        mine, others = envs.step(np.concatenate([actions[:1], actions])), truth.step(actions)
        for part, there in zip(mine[0].values(), others[0].values(), strict=True):
            np.testing.assert_array_equal(part[[1, 2]], there)
        for part, there in zip(mine[1:4], others[1:4], strict=True):
            np.testing.assert_array_equal(part[[1, 2]], there)


def test_the_others_do_not_notice_and_generators_go_on():
    envs, undisturbed = batch(), batch()
    for each in (envs, undisturbed):
        each.reset(seed=4)
    kept = envs.keep([0])
    for i in range(6):
        for each in (envs, undisturbed):
            each.step(drawn(each, i))
    numbers = [generator.bit_generator.state for generator in envs.np_random]
    envs.go_back([-1], kept)
    assert envs.np_random_seed == undisturbed.np_random_seed == (4, 5, 6)
    assert [generator.bit_generator.state for generator in envs.np_random] == numbers
    for i in range(6):
        mine, wanted = envs.step(drawn(envs, i)), undisturbed.step(drawn(envs, i))
        for part, there in zip(mine[0].values(), wanted[0].values(), strict=True):
            np.testing.assert_array_equal(part[:2], there[:2])
    mine, wanted = envs.reset(), undisturbed.reset()
    np.testing.assert_array_equal(mine[0]["vehicles"][2], wanted[0]["vehicles"][2])


def test_what_does_not_fit():
    envs, other = batch(), batch(config={"vehicles_count": 4})
    for each in (envs, other):
        each.reset(seed=0)
    before, kept = envs.snapshot(), envs.keep([0, 1])
    for indices, states, message in (
        ([1, 1], kept, r"indices: expected each environment once, got \[1, 1\]"),
        ([-1, 2], kept, "expected each environment once"),
        ([1], kept, "kept: expected what keep.. gives of 1 environments"),
        ([0, 1], other.keep([0, 1]), "of 2 environments like these, of the same id"),
        ([0, 1], kept[:-1], "kept: expected what"),
        ([0, 1], None, "kept: expected what"),
        ([0], "abc", "kept: expected what"),
        ([0, 3], kept, "number of an environment"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.go_back(indices, states)
        assert envs.snapshot() == before
    with pytest.raises(ValueError, match="keep, go_back and rest need the batch engine"):
        batch(accelerate=False).keep([0])
