"""IDM and MOBIL in the ego's place, in every scenario; what rewards read of them by hand."""

import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.dynamics import BicycleVehicle

from esc_agents.config import config_for_env, scenarios
from esc_agents.driving.baselines import rule_driver
from esc_agents.driving.environments import check_actions, make_env
from esc_agents.errors import UserError
from tests.esc_agents.tiny import ROAD, tiny

NO_LANES = {"parking", "parking-goal"}


def accepted(name, algo):
    try:
        check_actions(config_for_env(name).model_copy(update={"algo": algo}))
    except UserError:
        return False
    return True


TASKS = [(name, algo) for name in scenarios() for algo in ("ppo", "sac") if accepted(name, algo)]


@pytest.mark.parametrize(("name", "algo"), [task for task in TASKS if task[0] not in NO_LANES])
def test_it_drives_along_the_lanes_of_every_scenario(name, algo):
    env = make_env(config_for_env(name).model_copy(update={"algo": algo}), rule_driver=True)
    env.reset(seed=3)
    for _ in range(5):
        observation, reward, terminated, _, _ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)
        assert np.isfinite(reward)
        if terminated:
            break
    assert isinstance(env.unwrapped.vehicle, IDMVehicle)
    assert env._progress > 2  # of DrivingMonitor [m]


@pytest.mark.parametrize(("name", "algo"), [task for task in TASKS if task[0] in NO_LANES])
def test_where_it_cannot_drive_it_is_said_why(name, algo):
    config = config_for_env(name).model_copy(update={"algo": algo, "vec": "subproc"})
    with pytest.raises(UserError, match="expected lanes to follow, got a parking lot"):
        rule_driver(config, range(2))


def test_two_way_rewards_it_for_the_nearest_target_speed():
    env = make_env(config_for_env("two-way"), rule_driver=True)
    env.reset(seed=1)
    vehicle, found = env.unwrapped.vehicle, set()
    for _ in range(15):
        reward = env.step(0)[1]
        index = min(range(3), key=lambda i: abs((20, 25, 30)[i] - vehicle.speed))
        left = vehicle.target_lane_index == ("a", "b", 0)
        assert reward == pytest.approx(0.8 * index / 2 + 0.2 * left)
        found.add((index, left))
    assert len({index for index, _ in found}) == len({left for _, left in found}) == 2


def test_lane_keeping_leaves_it_the_egos_body():
    """A bicycle with tyre slip, steered by hand as the driver was, ends in the same places."""
    env = make_env(config_for_env("lane-keeping"), rule_driver=True)
    env.reset(seed=0)
    driver = env.unwrapped.vehicle
    twin = BicycleVehicle(driver.road, driver.position, driver.heading, driver.speed)
    for _ in range(30):
        env.step(np.ones(1, np.float32))
        twin.act(dict(driver.action))
        twin.step(0.1)
        assert driver.state.tolist() == twin.state.tolist()
    assert abs(driver.lateral_speed) > 1e-3


def test_throttle_and_steering_in_steps_have_a_neutral_action():
    config = tiny(env_config={**ROAD, "action": {"type": "DiscreteAction"}})
    env = make_env(config, rule_driver=True)
    env.reset(seed=0)
    assert env.step(0)[4]["action"] == 4  # in the middle of three throttles by three steerings
    assert env.unwrapped.action_type.last_action == (0, 0)
