"""Wrappers on a scripted environment first, then against stock highway-env."""

from math import cos
from types import SimpleNamespace

import gymnasium as gym
import highway_env  # noqa: F401  (registers the ids)
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from esc_agents.config import TrainConfig, config_for_env, scenarios
from esc_agents.driving.checks import check_seeds
from esc_agents.driving.environments import check_actions, env_config, factories, make_env
from esc_agents.driving.wrappers import DrivingMonitor, Progress, SeededEpisodes
from esc_agents.errors import UserError
from esc_agents.training.train import train
from esc_gym.fastsim.behavior import original_behavior
from tests.esc_agents.tiny import ROAD, tiny

SAC_SCENARIOS = [name for name in scenarios() if config_for_env(name).continuous]
LANE = SimpleNamespace(local_coordinates=lambda position: (0.0, 0.0), heading_at=lambda s: 0.2)


class Scripted(gym.Env):
    """Plays a list of (reward, terminated, attributes of the vehicle) and counts its calls."""

    observation_space = action_space = gym.spaces.Discrete(9)

    def __init__(self, *steps):
        self.steps, self.resets, self.played = steps, [], 0

    def reset(self, *, seed=None, options=None):
        self.resets.append(seed)
        self.left = list(self.steps)
        self.vehicle = SimpleNamespace(
            lane_index=("a", "b", 0), speed=0.0, crashed=False, on_road=True, heading=0.0,
            position=np.zeros(2), lane=LANE,
        )  # fmt: skip
        self.config = {"policy_frequency": 2}
        return len(self.resets), {"set": {"count": 0}}

    def step(self, action):
        self.played += 1
        reward, terminated, attributes = self.left.pop(0)
        vars(self.vehicle).update(attributes)
        count = attributes.get("count", 0)
        return self.played, reward, terminated, False, {"set": {"count": count}}


def test_progress_pays_for_speed_along_the_lane():
    env = Progress(
        Scripted(
            (1.0, False, {"speed": 30.0, "heading": 0.2}),  # along the lane
            (1.0, False, {"speed": 15.0, "heading": 0.2 + np.pi}),  # against it
            (1.0, False, {"speed": 20.0, "heading": 0.5, "on_road": False}),
        ),
        reward=0.6,
        offroad_terminal=False,
    )
    env.reset()
    steps = [env.step(0) for _ in range(3)]
    assert [s[1] for s in steps] == pytest.approx([1.6, 1 - 0.3, 1 + 0.4 * cos(0.3)])
    assert [s[2] for s in steps] == [False, False, False]


def test_progress_ends_off_the_road():
    env = Progress(Scripted((0.0, False, {"on_road": False})), 0.0, offroad_terminal=True)
    env.reset()
    assert env.step(0)[2] is True


def test_driving_monitor_adds_up():
    env = DrivingMonitor(
        Scripted(
            # A change of lanes, the next road, another change.
            (0.5, False, {"speed": 10.0, "count": 3, "lane_index": ("a", "b", 1)}),
            (-2.0, False, {"speed": 20.0, "count": 4, "lane_index": ("b", "c", 0),
                           "heading": 0.2, "on_road": False}),
            (1.0, False, {"speed": 30.0, "count": 5, "lane_index": ("b", "c", 2),
                          "on_road": True}),
            (0.0, True, {"speed": 0.0, "count": 0, "crashed": True}),
        )
    )  # fmt: skip
    for seed in (7, None):  # the second episode starts from nothing
        env.reset(seed=seed)
        infos = [env.step(0)[4] for _ in range(4)]
        assert not any("episode" in info for info in infos[:3])
        episode = infos[3]["episode"]
        assert episode.pop("t") >= 0
        assert episode == {
            "r": -0.5, "l": 4, "crashed": 1, "speed": 15.0, "lane_changes": 2, "vehicles": 3.0,
            "progress": pytest.approx((10 * cos(0.2) + 20 + 30) / 2), "off_road": 0.25,
            "min_ttc": float("inf"), "seed": seed,
        }  # fmt: skip


def test_seeded_episodes_play_their_seeds_and_rest():
    base = Scripted((1.0, False, {}), (1.0, True, {}))
    env = SeededEpisodes(base)
    env.set_seeds([5, 3])
    for _ in range(4):
        env.reset()
        for _ in range(2):
            env.step(0)
    assert base.resets == [5, 3]
    assert base.played == 4
    assert env.step(0)[1:4] == (0.0, False, False)
    env.set_seeds([9])
    env.reset()
    assert base.resets == [5, 3, 9]


def test_seeded_episodes_without_seeds_still_observe():
    base = Scripted((1.0, True, {}))
    env = SeededEpisodes(base)
    env.set_seeds([])
    assert env.reset()[0] == 1  # a vectorised env needs an observation of every member
    assert env.step(0)[4] == {}


@pytest.mark.parametrize("seed", [0, 1])
def test_monitor_equals_a_loop_over_stock_highway_env(seed):
    config = {**ROAD, "duration": 10}
    stock = gym.make("highway-fast-v0", config=config)
    ours = make_env(tiny(env_config=config), evaluation=True)
    ours.get_wrapper_attr("set_seeds")([seed])
    stock.reset(seed=seed)
    ours.reset()
    actions = np.random.default_rng(seed).integers(5, size=10)
    rewards, speeds, lanes = [], [], [stock.unwrapped.vehicle.lane_index[2]]
    start = stock.unwrapped.vehicle.position[0]
    for action in actions:
        _, reward, terminated, truncated, _ = stock.step(action)
        info = ours.step(action)[4]
        rewards.append(reward)
        speeds.append(stock.unwrapped.vehicle.speed)
        lanes.append(stock.unwrapped.vehicle.lane_index[2])
        if terminated or truncated:
            break
    episode = info["episode"]
    assert episode["r"] == pytest.approx(sum(rewards), abs=1e-12)
    assert episode["l"] == len(rewards)
    assert episode["speed"] == pytest.approx(np.mean(speeds))
    assert episode["crashed"] == stock.unwrapped.vehicle.crashed
    way = stock.unwrapped.vehicle.position[0] - start  # the road is straight; speeds vary in a step
    assert episode["progress"] == pytest.approx(way, rel=0.1)
    assert episode["off_road"] == 0
    assert episode["lane_changes"] == np.count_nonzero(np.diff(lanes))
    assert episode["seed"] == seed
    assert (episode["min_ttc"] == 0) >= episode["crashed"]


@pytest.mark.parametrize("env", ["highway-fast-v0", "intersection-v0", "racetrack-v0"])
def test_rule_driver_is_highway_envs_own(env):
    """Against stock highway-env with its own IDMVehicle put in by hand."""
    with original_behavior(IDMVehicle):  # stock intersections change it for the whole process
        ours = make_env(tiny(env), rule_driver=True)
        stock = gym.make(env, config=ROAD if env == "highway-fast-v0" else {})
        ours.reset(seed=3)
        stock.reset(seed=3)
        base = stock.unwrapped
        ego = base.vehicle
        driver = IDMVehicle(
            base.road, ego.position, ego.heading, ego.speed,
            getattr(ego, "target_lane_index", None), max(getattr(ego, "target_speeds", [40.0])),
            getattr(ego, "route", None),
        )  # fmt: skip
        base.road.vehicles[base.road.vehicles.index(ego)] = driver
        base.vehicle = base.action_type.controlled_vehicle = driver
        for _ in range(5):
            action = ours.action_space.sample()  # of no effect
            neutral = 1 if isinstance(ours.action_space, gym.spaces.Discrete) else action * 0
            returned, expected = ours.step(action), stock.step(neutral)
            assert list(ours.unwrapped.vehicle.position) == list(driver.position)
            assert returned[1:4] == expected[1:4]
            if returned[2] or expected[2]:
                break
        assert ours.unwrapped.vehicle.speed == driver.speed


def test_sac_changes_the_scenario_and_ppo_does_not():
    config = TrainConfig.model_validate(
        {
            "env_config": {"lanes_count": 3, "action": {"type": "DiscreteMetaAction"}},
            "continuous": {
                "env_config": {"action": {"type": "ContinuousAction"}, "policy_frequency": 5}
            },
        }
    )
    assert env_config(config) == config.env_config
    sac = config.model_copy(update={"algo": "sac"})
    assert env_config(sac) == {
        "lanes_count": 3, "action": {"type": "ContinuousAction"}, "policy_frequency": 5,
    }  # fmt: skip
    assert config.env_config["action"] == {"type": "DiscreteMetaAction"}  # untouched


def test_a_nested_change_of_the_same_type_is_merged():
    action = {"type": "ContinuousAction", "steering_range": [-1, 1]}
    config = TrainConfig.model_validate(
        {
            "algo": "sac",
            "env_config": {"action": action},
            "continuous": {"env_config": {"action": {"lateral": False}}},
        }
    )
    assert env_config(config)["action"] == {**action, "lateral": False}


def step_once(config):
    env = make_env(config)
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    observation, reward, *_ = env.step(env.action_space.sample())
    assert env.observation_space.contains(observation)
    assert np.isfinite(reward)
    return env


@pytest.mark.parametrize("name", scenarios())
def test_every_scenario_drives(name):
    config = config_for_env(name)
    check_actions(config)
    env = step_once(config)
    for key, value in config.env_config.items():
        if not isinstance(value, dict):
            assert env.unwrapped.config[key] == value


@pytest.mark.parametrize("name", SAC_SCENARIOS)
def test_every_continuous_scenario_drives_with_throttle_or_steering(name):
    config = config_for_env(name).model_copy(update={"algo": "sac"})
    check_actions(config)
    space = step_once(config).action_space
    assert isinstance(space, gym.spaces.Box)
    assert space.shape in [(1,), (2,)]


@pytest.mark.parametrize("env", ["merge-v0", "merge-dense", "roundabout-v0", "two-way-v0"])
def test_sac_is_refused_where_highway_env_cannot(env):
    config = config_for_env(env).model_copy(update={"algo": "sac"})
    with pytest.raises(UserError, match=r"cannot do continuous actions here, since its reward"):
        check_actions(config)
    continuous = {"env_config": {"action": {"type": "ContinuousAction"}}, "algo": "ppo"}
    with pytest.raises(UserError, match=r"use --algo ppo with meta-actions"):
        check_actions(config.model_copy(update=continuous))


def test_sac_is_refused_on_discrete_actions():
    config = TrainConfig(algo="sac", env="highway-fast-v0")
    with pytest.raises(UserError, match="expected continuous actions, got DiscreteMetaAction"):
        check_actions(config)


def test_order_of_the_rows():
    def order(**changes):
        return make_env(tiny(**changes)).get_wrapper_attr("set_spec").order

    assert order() == "road"
    assert order(repr="ap") == "shuffled"
    assert order(repr="ap", observation={"order": "distance"}) == "distance"


def test_shuffling_permutes_rows_and_nothing_else():
    many = tiny(env_config={**ROAD, "vehicles_count": 15})
    plain, shuffled = make_env(many), make_env(many, shuffle=True)
    moved = False
    a, b = plain.reset(seed=0)[0], shuffled.reset(seed=0)[0]
    for _ in range(4):
        m = a["mask"].sum()
        assert m > 2
        assert {tuple(row) for row in a["vehicles"][:m]} == {tuple(r) for r in b["vehicles"][:m]}
        np.testing.assert_array_equal(a["ego"], b["ego"])
        moved |= not np.array_equal(a["vehicles"], b["vehicles"])
        a, b = plain.step(1)[0], shuffled.step(1)[0]
    assert moved


def test_factories_make_separate_environments():
    first, second = (factory() for factory in factories(tiny(), 2))
    assert first.unwrapped is not second.unwrapped


@pytest.mark.parametrize("seed", [1_000_000, 999_999, 1_000_019])
def test_training_has_no_episode_of_the_evaluations(seed, tmp_path):
    judged = {"episodes": 20}
    with pytest.raises(UserError, match=f"have the seeds 1000000 to 1000019; got {seed} for"):
        train(tiny(seed=seed, evaluation=judged, run_dir=tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    for free in (999_998, 1_000_020):
        check_seeds(tiny(seed=free, evaluation=judged))
