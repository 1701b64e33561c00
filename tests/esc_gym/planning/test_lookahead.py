"""Looking ahead, beside the same plans in deep copies of what highway-env simulates."""

from copy import deepcopy
from itertools import pairwise

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from esc_gym.fastsim.kernel import VEHICLES
from esc_gym.fastsim.records import IDM
from esc_gym.planning import OWN, LookAhead, best, guess, idm_actions, meta_actions, rollouts
from tests.esc_gym.planning.scenes import IDS, by_deep_copies, driven, restless
from tests.esc_gym.vector.stock import batch


@pytest.mark.parametrize("env_id", IDS)
def test_values_are_those_of_deep_copies(env_id):
    planner = LookAhead(horizon=7, free=1, continuations=None, discount=0.9)
    envs, others = driven(env_id)
    plans = planner.sequences(envs)
    found = [[by_deep_copies(other, of_one, planner) for of_one in plans] for other in others]
    expected = [[max(returns) for returns, _ in of_one] for of_one in found]
    assert sum(crashes for of_one in found for _, crashes in of_one) > 0
    np.testing.assert_array_equal(planner.values(envs), expected)
    np.testing.assert_array_equal(
        planner.values(envs, [1, 0, -1]), [expected[i] for i in (1, 0, 1)]
    )


@pytest.mark.parametrize("env_id", IDS)
def test_a_policy_drives_on_as_in_deep_copies(env_id):
    planner = LookAhead(horizon=6, free=1, continuations=(), policy=restless)
    envs, others = driven(env_id)
    plans = planner.sequences(envs)
    assert plans[:, 0].tolist() == [[action, *[OWN] * 5] for action in range(len(plans))]
    returns = [by_deep_copies(other, plans[:, 0], planner, restless)[0] for other in others]
    np.testing.assert_array_equal(planner.values(envs), returns)
    without = LookAhead(horizon=6, free=1).values(envs)
    both = LookAhead(horizon=6, free=1, policy=restless).values(envs)
    np.testing.assert_array_equal(both, np.maximum(without, returns))


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_planning_leaves_the_batch_alone(mode):
    envs, _ = driven(IDS[0], autoreset_mode=mode)
    before = envs.snapshot()
    first = LookAhead().values(envs)
    assert envs.snapshot() == before
    np.testing.assert_array_equal(LookAhead().values(envs), first)
    assert envs.autoreset_mode.value == mode
    envs.step(np.zeros(2, int))


def test_sequences_are_free_actions_then_a_continuation():
    envs, _ = driven(IDS[0], steps=0)
    numbers = meta_actions(envs)
    idle, slower = numbers["IDLE"], numbers["SLOWER"]
    once = LookAhead(horizon=3, free=1).sequences(envs).tolist()
    assert once == [[[a, idle, idle], [a, slower, slower]] for a in range(5)]
    twice = LookAhead(horizon=3).sequences(envs).tolist()
    assert twice == [[[a, b, c] for b in range(5) for c in (idle, slower)] for a in range(5)]
    named = LookAhead(horizon=2, free=1, continuations=None).sequences(envs)
    assert named[3, :, 1].tolist() == list(numbers.values())


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


def after_a_step(envs):
    """Where the others will be."""
    copies = envs.fork([0, 1])
    copies.step(np.ones(2, int))
    return copies.engine.state.vehicles["x"]


@pytest.mark.parametrize("env_id", IDS)
def test_guesses_do_not_depend_on_what_cannot_be_seen(env_id):
    envs, _ = driven(env_id)
    planner = LookAhead(knows="observed", seed=3)
    before = envs.snapshot()
    guessed, goes_on = planner.values(envs), after_a_step(envs)
    assert envs.snapshot() == before
    state = envs.engine.state
    for e, (n, _, _, ego) in enumerate(state.counts):
        others = np.delete(np.arange(n), ego)
        for name, value in {
            "target_speed": 3.0, "delta": 2.0, "timer": 0.77, "politeness": 0.5, "yielding": 1,
            "route_length": 0,
        }.items():  # fmt: skip
            state.vehicles[name][e, others] = value
    assert (after_a_step(envs) != goes_on).any()
    np.testing.assert_array_equal(planner.values(envs), guessed)
    np.testing.assert_array_equal(planner.values(envs, [1, -1]), guessed[[1, 1]])


@pytest.mark.parametrize("env_id", IDS)
def test_guesses_hold_what_can_be_seen(env_id):
    envs, (stock_env, _) = driven(env_id, perception_distance=50)
    copies = guess(envs, [0], futures=3, seed=0)
    ego, road = stock_env.unwrapped.vehicle, stock_env.unwrapped.road
    seen = [v for v in road.vehicles if np.hypot(*(v.position - ego.position)) <= 50]
    assert len(seen) > 1
    routes = set()
    for copy in range(3):
        base = copies.materialise(copy).unwrapped
        assert len(base.road.vehicles) == len(seen)
        assert len(base.road.objects) == len(road.objects)
        assert base.road.vehicles.index(base.vehicle) == seen.index(ego)
        for there, here in zip(seen, base.road.vehicles, strict=True):
            for name in ("position", "heading", "speed", "lane_index", "LENGTH", "WIDTH"):
                np.testing.assert_array_equal(getattr(here, name), getattr(there, name))
            if here is base.vehicle:
                assert here.target_speed == ego.target_speed
                continue
            assert here.target_lane_index == there.lane_index
            assert here.target_speed >= there.speed
            assert here.DELTA == IDMVehicle.DELTA
            for (_, end, _), (start, *_) in pairwise(here.route):
                assert end == start  # roads that follow each other
            assert here.route[0][:2] == here.lane_index[:2]
        routes.add(str([v.route for v in base.road.vehicles]))
    assert (len(routes) > 1) == (env_id == "esc_gym/intersection-v0")


def test_the_best_action_is_taken_and_idle_among_equals(monkeypatch):
    envs, _ = driven(IDS[0], steps=0)
    values = np.array([[3.0, 3.0, 1.0, 0.0, 0.0], [0.0, 1.0, 2.0, 2.0, 0.0]])
    monkeypatch.setattr(LookAhead, "values", lambda self, envs: values)
    np.testing.assert_array_equal(LookAhead().actions(envs), [1, 2])


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"horizon": 0}, "horizon: expected at least 1, got 0"),
        ({"futures": 0}, "futures: expected at least 1, got 0"),
        ({"horizon": 3, "free": 4}, "free: expected at most the horizon, 3, got 4"),
        ({"knows": "some"}, "knows: expected 'all' or 'observed', got 'some'"),
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


def by_a_driver_of_highway_env(env):
    """(lane aimed at, speed) after a step with highway-env's driver in the ego's place, and after
    each meta-action."""

    def after(copy, action):
        copy.step(action)
        vehicle = copy.unwrapped.vehicle
        return vehicle.target_lane_index, vehicle.speed

    with_driver = deepcopy(env)
    base = with_driver.unwrapped
    ego, vehicles = base.vehicle, base.road.vehicles
    driver = IDMVehicle(
        base.road, ego.position, ego.heading, ego.speed, ego.target_lane_index,
        float(ego.target_speeds[-1]), ego.route, timer=IDMVehicle.LANE_CHANGE_DELAY,
    )  # fmt: skip
    driver.speed_index = 0  # which rewards read of an ego
    driver.target_speeds = ego.target_speeds
    vehicles[vehicles.index(ego)] = base.vehicle = base.action_type.controlled_vehicle = driver
    idle = base.action_type.actions_indexes["IDLE"]
    return after(with_driver, idle), [
        after(deepcopy(env), action) for action in range(env.action_space.n)
    ]


@pytest.mark.parametrize("env_id", IDS)
def test_what_idm_and_mobil_would_do(env_id):
    """Nearest to highway-env's own driver: first in the lane, then in speed."""
    found = set()
    for steps in (1, 3, 5):
        envs, others = driven(env_id, 6, steps)
        chosen = idm_actions(envs)
        np.testing.assert_array_equal(idm_actions(envs, [4, 0]), chosen[[4, 0]])
        for e, other in enumerate(others):
            (lane, speed), outcomes = by_a_driver_of_highway_env(other)
            there = [i for i, (aim, _) in enumerate(outcomes) if aim == lane]
            off = {i: abs(outcomes[i][1] - speed) for i in there or range(len(outcomes))}
            assert off[chosen[e]] == pytest.approx(min(off.values()), abs=1e-9)
            found.add(int(chosen[e]))
    assert len(found) > 1


def test_idm_among_ties_keeps_on():
    envs, _ = driven("esc_gym/intersection-v0", 1, 1)
    numbers = meta_actions(envs)
    assert best(np.zeros((2, len(numbers))), numbers).tolist() == [numbers["IDLE"]] * 2


@pytest.mark.parametrize(
    ("env_id", "expected"),
    [("esc_gym/intersection-v0", (7, 6, -3)), ("esc_gym/highway-fast-v0", (10, 3, -5))],
)
def test_guessed_drivers_are_those_of_the_scenario(env_id, expected):
    """As in the source of IntersectionEnv, which changes the class for the whole process."""
    envs, _ = driven(env_id, 1)
    state = guess(envs, [0], 1, 0).engine.state
    drivers = state.vehicles[0, : state.counts[0, VEHICLES]]
    drivers = drivers[drivers["kind"] == IDM]
    names = ["distance_wanted", "comfort_max", "comfort_min"]
    assert {tuple(map(float, row)) for row in drivers[names]} == {expected}
