"""Labelled episodes: those that single environments have, and what the expert said of them."""

import numpy as np
import pytest

from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.environments import make_env
from esc_agents.errors import UserError
from esc_agents.imitation import labels
from esc_agents.imitation.experts import expert_of
from esc_agents.imitation.labels import Drive, Labels, collect, split
from esc_gym.planning import LookAhead
from tests.esc_agents.imitation.small import small

PLANNER = LookAhead(**small().planner.model_dump(include={"horizon", "free"}))
SEEDS = [5, 6, 9, 7, 8]


@pytest.fixture(scope="module")
def config():
    return small().train_config()


@pytest.fixture(scope="module")
def expert(config):
    return expert_of("planner", small().planner, config)


def driven(config, expert, seeds=SEEDS, learner=None, noise=0.5, count=2, **options):
    envs = BatchVecEnv(config, count, evaluation=True)
    return collect(envs, seeds, expert, learner, noise, np.random.default_rng(3), **options)


def test_episodes_are_those_of_single_environments(config, expert):
    """Observations and rewards of the same actions; values of a planner in that very state."""
    drives = driven(config, expert)
    assert [drive.seed for drive in drives] == SEEDS
    alone = BatchVecEnv(config, 1)
    for drive in drives:
        env = make_env(config)
        seen, _ = env.reset(seed=drive.seed)
        alone.envs.reset(seed=drive.seed)
        for step, action in enumerate(drive.actions):
            for name, part in seen.items():
                np.testing.assert_array_equal(drive.observations[name][step], part)
            planned = PLANNER.values(alone.envs)[0].astype(np.float32)
            np.testing.assert_array_equal(drive.values[step], planned)
            alone.envs.step([action])
            seen, reward, terminated, truncated, _ = env.step(action)
            assert drive.rewards[step] == np.float32(reward)
        assert terminated or truncated
        assert terminated == drive.terminated
        for name, part in seen.items():
            np.testing.assert_array_equal(drive.observations[name][-1], part)
            assert len(drive.observations[name]) == len(drive.actions) + 1


def test_who_drives(config, expert):
    """Without noise the expert's best action, or what the learner says; all with noise 1."""
    for drive in driven(config, expert, noise=0.0):
        lost = drive.values.max(axis=1) - drive.values[np.arange(len(drive.actions)), drive.actions]
        assert not lost.any()
    for drive in driven(config, expert, learner=lambda seen: np.full(2, 3), noise=0.0):
        assert (drive.actions == 3).all()
    random = np.concatenate([drive.actions for drive in driven(config, expert, noise=1.0)])
    assert set(random) == set(range(5))


def test_stopped(config, expert):
    calls = iter([False] * 8 + [True])
    drives = driven(config, expert, stop=lambda: next(calls))
    assert 0 < len(drives) < len(SEEDS)


def test_saved_and_loaded(config, expert, tmp_path):
    drives = driven(config, expert)
    labels.save(tmp_path / "a.npz", drives)
    for one, two in zip(drives, labels.load(tmp_path / "a.npz"), strict=True):
        assert (one.seed, one.terminated) == (two.seed, two.terminated)
        for a, b in zip(flat(one), flat(two), strict=True):
            np.testing.assert_array_equal(a, b)
            assert a.dtype == b.dtype
    labels.save(tmp_path / "b.npz", drives)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    (tmp_path / "a.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-50])
    with pytest.raises(UserError, match=r"a\.npz is damaged .* remove it"):
        labels.load(tmp_path / "a.npz")


def flat(drive):
    return [*drive.observations.values(), drive.actions, drive.values, drive.rewards]


def test_whole_episodes_are_held_out():
    drives = [
        Drive(
            seed, {"ego": np.full((3, 1), seed)}, np.zeros(2), np.zeros((2, 5)), np.zeros(2), True
        )
        for seed in range(25)
    ]
    learnt, held = split(drives)
    assert [drive.seed for drive in held] == [9, 19]
    assert len(learnt) == 23
    together = Labels.of(held)
    assert together.observations["ego"].tolist() == [[9], [9], [19], [19]]  # no last observation
    assert len(together) == 4
    for count in range(2, 10):  # few are too few for every tenth
        learnt, held = split(drives[:count])
        assert [len(learnt), [drive.seed for drive in held]] == [count - 1, [count - 1]]
