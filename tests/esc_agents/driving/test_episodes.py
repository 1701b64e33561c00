import json

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3.common.vec_env import DummyVecEnv

from esc_agents.config import config_for_env
from esc_agents.driving.baselines import blind_policies
from esc_agents.driving.environments import factories, make_env
from esc_agents.driving.episodes import Episode, Summary, as_rows, evaluate, summaries, table
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.driving.wrappers import DrivingMonitor
from esc_agents.files import finite
from tests.esc_agents.tiny import ROAD, tiny

SEEDS = [11, 4, 7, 5, 8]
IDLE, FASTER = 1, 3


def drive(count, policy, seeds=SEEDS, **options):
    envs = DummyVecEnv(factories(tiny(), count, evaluation=True))
    return evaluate(envs, policy, seeds, **options)


def always(action, count):
    return lambda observations: np.full(count, action)


@pytest.fixture(scope="module")
def stock_returns():
    """Return, length and crash of always FASTER, from a plain loop over stock highway-env."""
    env = gym.make("highway-fast-v0", config=ROAD)
    results = []
    for seed in SEEDS:
        env.reset(seed=seed)
        total, length, ended = 0.0, 0, False
        while not ended:
            _, reward, terminated, truncated, _ = env.step(FASTER)
            total, length, ended = total + reward, length + 1, terminated or truncated
        results.append((total, length, env.unwrapped.vehicle.crashed))
    return results


@pytest.mark.parametrize("count", [1, 2, 5, 7])
def test_one_episode_per_seed_in_order_with_any_number_of_environments(
    count, stock_returns, monkeypatch
):
    resets = []
    reset = DrivingMonitor.reset
    monkeypatch.setattr(
        DrivingMonitor, "reset", lambda self, **given: resets.append(given) or reset(self, **given)
    )
    episodes = drive(count, always(FASTER, count))
    played = [given["seed"] for given in resets if given["seed"] is not None]
    assert sorted(played) == sorted(SEEDS)  # once each, and none for nothing
    assert [e.seed for e in episodes] == SEEDS
    assert [(e.length, e.crashed) for e in episodes] == [r[1:] for r in stock_returns]
    assert [e.reward for e in episodes] == pytest.approx([r[0] for r in stock_returns])


def test_the_episodes_differ(stock_returns):
    # Otherwise the test above could not see a wrong order.
    assert len({total for total, *_ in stock_returns}) == len(SEEDS)


def test_again_with_the_same_environments():
    envs = DummyVecEnv(factories(tiny(), 2, evaluation=True))
    first = evaluate(envs, always(IDLE, 2), SEEDS[:3])
    other = evaluate(envs, always(FASTER, 2), SEEDS[:3])
    assert evaluate(envs, always(IDLE, 2), SEEDS[:3]) == first != other


def test_stopping_gives_what_has_ended():
    steps = iter(range(100))
    episodes = drive(1, always(IDLE, 1), stop=lambda: next(steps) >= 7)
    assert [e.seed for e in episodes] == SEEDS[:1]  # 6 steps an episode: one whole in 7


def test_summary():
    def episode(reward, crashed, ttc):
        return Episode(0, reward, 10, crashed, 20.0, 200.0, 0.0, 1, 5.0, ttc)

    summary = Summary.of(
        [episode(1.0, True, 0.0), episode(3.0, False, 4.0), episode(2.0, False, float("inf"))]
    )
    assert summary.reward == pytest.approx(2.0)
    assert summary.reward_high - 2 == pytest.approx(4.302653 * 1 / np.sqrt(3))  # t(0.975, 2)
    assert summary.collision_rate == pytest.approx(1 / 3)
    assert (summary.collision_low, summary.collision_high) == pytest.approx(
        (0.0615, 0.7923), abs=1e-4
    )
    assert summary.min_ttc == 4.0
    row = as_rows({"esc": summary})[0]
    assert (row["policy"], row["episodes"], row["speed"]) == ("esc", 3, 20.0)


@pytest.mark.parametrize("vec", ["dummy", "batch"])
def test_who_arrives(vec):
    """At the intersection, where highway-env says so; elsewhere there is no such thing."""
    config = config_for_env("intersection-v0").model_copy(update={"n_envs": 2, "vec": vec})
    with closing(vectorise(config, 2, evaluation=True)) as envs:
        episodes = evaluate(envs, always(2, 2), SEEDS)  # FASTER
    for episode in episodes:
        env = make_env(config)
        env.reset(seed=episode.seed)
        over = False
        while not over:
            *_, terminated, truncated, _ = env.step(2)
            over = terminated or truncated
        base = env.unwrapped
        assert episode.arrived == base.has_arrived(base.vehicle)
    assert not all(episode.arrived for episode in episodes)
    assert any(episode.arrived for episode in episodes)
    header, row = table({"esc": Summary.of(episodes)})
    share = np.mean([episode.arrived for episode in episodes])
    assert dict(zip(header, row, strict=True))["arrived"] == f"{share:.0%}"
    (nowhere,) = drive(1, always(IDLE, 1))[:1]
    assert nowhere.arrived is None
    assert "arrived" not in table({"idle": Summary.of([nowhere])})[0]


def test_summaries_survive_json():
    one = Summary.of([Episode(0, 1.0, 10, False, 20.0, 200.0, 0.0, 1, 5.0, float("inf"))])
    two = Summary.of([Episode(0, 1.0, 10, False, 20.0, 200.0, 0.0, 1, 5.0, 1.0, True)])
    rows = json.loads(json.dumps(finite(as_rows({"one": one, "two": two}))))
    assert summaries(rows) == {"one": one, "two": two}


def test_blind_policies_of_discrete_actions():
    names = {0: "LEFT", 1: "IDLE", 2: "RIGHT"}
    policies = blind_policies(gym.spaces.Discrete(3), 4, names, seed=0)
    assert list(policies) == ["always LEFT", "always IDLE", "always RIGHT", "random"]
    np.testing.assert_array_equal(policies["always RIGHT"]({}), [2, 2, 2, 2])
    drawn = np.concatenate([policies["random"]({}) for _ in range(50)])
    assert set(drawn) == {0, 1, 2}


@pytest.mark.parametrize("size", [1, 2])
def test_blind_policies_of_continuous_actions(size):
    space = gym.spaces.Box(-1, 1, (size,), np.float32)
    policies = blind_policies(space, 3, {}, seed=0)
    assert ("always full throttle" in policies) == (size == 2)
    for policy in policies.values():
        actions = policy({})
        assert actions.shape == (3, size)
        assert all(space.contains(action) for action in actions)
    again = blind_policies(space, 3, {}, seed=0)["random"]
    assert not np.array_equal(policies["random"]({}), again({}))  # the second against the first
