"""SetVectorEnv as Gymnasium's rules have it, and its whole state in hand."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics
from highway_env.envs.highway_env import HighwayEnv
from highway_env.vehicle.behavior import IDMVehicle

from esc_gym.fastsim.records import NO_LANE
from esc_gym.vector.environment import SetVectorEnv
from tests.esc_gym.vector.stock import batch, check, row, snap

FAST = "esc_gym/highway-fast-v0"
CONFIG = {"vehicles_count": 8, "duration": 6}


def same(a, b):
    """Equal to the last bit, of nested results."""
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            same(a[key], b[key])
    elif isinstance(a, tuple | list) or (isinstance(a, np.ndarray) and a.dtype == object):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            same(x, y)
    else:
        np.testing.assert_array_equal(a, b)


def drive(envs, steps, seed=0):
    rng = np.random.default_rng(seed)
    n = envs.single_action_space.n
    return [envs.step(rng.integers(0, n, envs.num_envs)) for _ in range(steps)]


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_as_gymnasiums_own_vector_environment(mode):
    """One environment after the other, in the forms in which Gymnasium returns them."""

    def make():
        return gym.make(FAST, config=CONFIG)

    ours = batch(FAST, 3, CONFIG, autoreset_mode=mode)
    theirs = SyncVectorEnv([make] * 3, autoreset_mode=mode)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata["autoreset_mode"] is AutoresetMode(mode)
    observation, _ = ours.reset(seed=5)
    expected, _ = theirs.reset(seed=5)
    same(observation, expected)
    assert observation in ours.observation_space
    ended = 0
    for mine, other in zip(drive(ours, 25), drive(theirs, 25), strict=True):
        same(mine[:4], other[:4])
        for e in range(3):
            if other[4]["_action"][e] and mine[4].get("_action", np.zeros(3))[e]:
                found, wanted = row(mine[4], e), row_of_theirs(other[4], e)
                same(found, wanted)
        if mode == "SameStep" and (done := other[2] | other[3]).any():
            same(mine[4]["_final_obs"], done)
            same(mine[4]["final_obs"][done], other[4]["final_obs"][done])
            ended += done.sum()
            for e in np.flatnonzero(done):
                same(row(mine[4]["final_info"], e), row_of_theirs(other[4]["final_info"], e))
            for name in ("speed", "crashed", "action", "rewards"):
                for key in (name, f"_{name}"):
                    same(mine[4]["final_info"][key], other[4]["final_info"][key])
            assert mine[4]["final_info"].keys() == other[4]["final_info"].keys()
    assert ended > 3 or mode == "NextStep"
    ours.close()


def row_of_theirs(infos, e):
    found = {}
    for name, value in infos.items():
        if name.startswith(("_", "final")) or not infos[f"_{name}"][e]:
            continue
        found[name] = row_of_theirs(value, e) if isinstance(value, dict) else value[e]
    return found


def test_a_reset_says_nothing_of_rewards_for_an_action():
    """None was taken; highway-env's info tells those of one that it drew."""
    envs = gym.make_vec("esc_gym/racetrack-v0", 2)
    _, infos = envs.reset(seed=0)
    assert "lane_centering_reward" in infos["rewards"]
    assert not {"action_reward", "_action_reward"} & infos["rewards"].keys()
    infos = envs.step(np.full((2, 1), 0.5, np.float32))[4]
    same(infos["rewards"]["action_reward"], [0.5, 0.5])
    _, infos = envs.reset(options={"reset_mask": np.array([True, False])})
    same(infos["_speed"], [True, False])
    assert infos["speed"][1] == 0


def test_disabled_waits_for_a_reset_of_those_that_ended():
    envs = batch(FAST, 3, CONFIG, autoreset_mode="Disabled")
    envs.reset(seed=0)
    while not (done := np.logical_or(*envs.step(np.full(3, 3))[2:4])).any():
        pass
    with pytest.raises(ValueError, match="has ended; reset it first"):
        envs.step(np.ones(3, int))
    before = [envs.materialise(e).unwrapped.time for e in range(3)]
    _, infos = envs.reset(options={"reset_mask": done})
    assert (infos["_speed"] == done).all()
    after = [envs.materialise(e).unwrapped.time for e in range(3)]
    assert after == [0 if over else time for over, time in zip(done, before, strict=True)]
    envs.step(np.ones(3, int))


def test_wrappers_of_gymnasium():
    envs = RecordEpisodeStatistics(batch(FAST, 4, CONFIG, autoreset_mode="SameStep"))
    envs.reset(seed=1)
    infos = [infos for *_, infos in drive(envs, 20)]
    lengths = [n for info in infos if "episode" in info for n in info["episode"]["l"]]
    assert 1 <= max(lengths) <= 6
    listed = DictInfoToList(batch(FAST, 2, CONFIG))
    assert [set(info) for info in listed.reset(seed=0)[1]] == [
        {"speed", "crashed", "rewards", "set"}
    ] * 2


def test_results_do_not_depend_on_the_number_of_threads():
    results = []
    for threads in (1, 2, 3, 16):
        envs = batch(FAST, 7, CONFIG, threads=threads)
        results.append([envs.reset(seed=3), *drive(envs, 12)])
        envs.close()
    for other in results[1:]:
        same(results[0], other)


def test_a_seed_for_each_and_going_on_without():
    envs = batch(FAST, 3, CONFIG)
    first, _ = envs.reset(seed=[7, None, 9])
    alone, _ = gym.make(FAST, config=CONFIG).reset(seed=9)
    same({name: part[2] for name, part in first.items()}, alone)
    assert envs.np_random_seed[0] == 7
    again, _ = envs.reset()
    assert (again["vehicles"] != first["vehicles"]).any()
    second, _ = envs.reset(seed=[7, None, 9])
    same({n: p[[0, 2]] for n, p in second.items()}, {n: p[[0, 2]] for n, p in first.items()})


def test_snapshot_and_restore():
    envs = batch(FAST, 4, CONFIG, order="shuffled")
    envs.reset(seed=0)
    last = drive(envs, 5)[-1]
    data = envs.snapshot()
    future = drive(envs, 15, seed=1)
    observation, infos = envs.restore(data)
    same(observation, last[0])
    same(infos["speed"], last[4]["speed"])
    same(drive(envs, 15, seed=1), future)
    other = batch(FAST, 4, CONFIG, order="shuffled", threads=2)
    other.restore(data)
    same(drive(other, 15, seed=1), future)


def test_fork():
    envs = batch(FAST, 4, CONFIG)
    envs.reset(seed=0)
    drive(envs, 3)
    copies = envs.fork([2, 0, 2])
    assert copies.num_envs == 3
    assert copies.observation_space["vehicles"].shape[0] == 3
    actions = np.random.default_rng(4).integers(0, 5, (15, 3))
    futures = [copies.step(a) for a in actions]
    for a, future in zip(actions, futures, strict=True):
        mine = envs.step(np.array([a[1], 1, a[0], 1]))
        for copied, e in ((0, 2), (1, 0)):
            same([part[copied] for part in future[1:4]], [part[e] for part in mine[1:4]])
            same(
                {n: p[copied] for n, p in future[0].items()}, {n: p[e] for n, p in mine[0].items()}
            )
        if any(mine[2] | mine[3]) or any(future[2] | future[3]):
            break


def test_a_materialised_environment_goes_on_as_the_batch():
    envs = batch("esc_gym/roundabout-v0", 3, {}, order="shuffled")
    envs.reset(seed=3)
    drive(envs, 2)
    env = envs.materialise(1)
    for action in (1, 0, 2, 1):
        mine = envs.step(np.array([1, action, 1]))
        alone = env.step(action)
        same({name: part[1] for name, part in mine[0].items()}, alone[0])
        same([part[1] for part in mine[1:4]], list(alone[1:4]))
        if alone[2] or alone[3]:
            break
    assert env.unwrapped.np_random.bit_generator.state == envs.np_random[1].bit_generator.state


def test_frames_of_all():
    envs = batch(FAST, 2, CONFIG, render_mode="rgb_array")
    envs.reset(seed=0)
    frames = envs.render()
    alone = gym.make(FAST, config=CONFIG, render_mode="rgb_array")
    alone.reset(seed=1)
    same(frames[1], alone.render())


UNKNOWN = {
    "a vehicle": (FAST, {"other_vehicles_type": f"{__name__}.Mine"}, "traffic of Mine"),
    "stock": (FAST, {}, "accelerate=False"),
}


class Mine(IDMVehicle):
    """Somebody's own."""


@pytest.mark.parametrize("name", UNKNOWN)
def test_what_the_engine_does_not_know_runs_one_by_one(name):
    env_id, config, reason = UNKNOWN[name]
    envs = gym.make_vec(env_id, 2, config=config, accelerate=name != "stock")
    assert not envs.unwrapped.report().engine
    assert envs.unwrapped.report().reason == reason
    assert reason in str(envs.unwrapped.report())
    observation, infos = envs.reset(seed=0)
    alone, info = gym.make(env_id, config=config, accelerate=name != "stock").reset(seed=1)
    same({name: part[1] for name, part in observation.items()}, alone)
    assert infos["set"]["ids"].dtype == int
    assert row(infos, 1)["set"]["ids"] == info["set"]["ids"]
    with pytest.raises(ValueError, match=f"does not simulate this: {reason}"):
        envs.unwrapped.snapshot()


def test_replaced_code_is_not_repeated(monkeypatch):
    monkeypatch.setattr(HighwayEnv, "_reward", lambda self, action: 7.0)
    envs = gym.make_vec(FAST, 2, config=CONFIG).unwrapped
    assert envs.report().reason == "code of highway-env was replaced"
    envs.reset(seed=0)
    assert (envs.step(np.ones(2, int))[1] == 7.0).all()


BAD_ARGUMENTS = {
    "num_envs": ({"num_envs": 0}, "num_envs: expected a whole number of at least 1, got 0"),
    "threads": ({"threads": -1}, "threads: expected a whole number"),
    "mode": ({"autoreset_mode": "Never"}, "autoreset_mode: expected one of 'NextStep'"),
    "config": ({"config": {"lane_count": 3}}, "unknown key 'lane_count'"),
    "observation": ({"max_vehicles": 0}, "max_vehicles: expected a whole number"),
    "human": ({"render_mode": "human"}, "render_mode: expected None or 'rgb_array'"),
    "no argument": ({"thread": 2}, "unexpected argument 'thread'; did you mean 'threads'"),
}


@pytest.mark.parametrize("name", BAD_ARGUMENTS)
def test_bad_arguments(name):
    arguments, message = BAD_ARGUMENTS[name]
    with pytest.raises((ValueError, TypeError), match=message):
        SetVectorEnv("highway-fast-v0", **arguments)


@pytest.mark.parametrize(
    ("env_id", "config", "actions", "message"),
    [
        (FAST, CONFIG, np.ones(3, int), r"expected shape \(2,\), got \(3,\)"),
        (FAST, CONFIG, np.array([1, 5]), "expected 0 to 4, got 5"),
        (FAST, CONFIG, np.array([-1, 1]), "expected 0 to 4, got -1"),
        (FAST, CONFIG, np.array([1.0, 1.0]), "expected whole numbers, got float64"),
        (FAST, {"action": {"type": "ContinuousAction"}}, [[0, np.nan]] * 2, "finite"),
    ],
)
def test_bad_actions_change_nothing(env_id, config, actions, message):
    envs = batch(env_id, 2, config)
    envs.reset(seed=0)
    before = envs.snapshot()
    with pytest.raises(ValueError, match=message):
        envs.step(actions)
    assert envs.snapshot() == before


def test_bad_snapshots_change_nothing():
    envs = batch(FAST, 2, CONFIG)
    envs.reset(seed=0)
    data = envs.snapshot()
    damaged = bytearray(data)
    damaged[-1] ^= 1
    others = batch(FAST, 2, {**CONFIG, "duration": 7})
    more = batch(FAST, 3, CONFIG, max_episode_steps=4)
    for envs_of_others in (others, more):
        envs_of_others.reset(seed=0)
    for bad, message in (
        (b"", "damaged, or of another version"),
        (data.replace(b"snapshot 3", b"snapshot 2"), "another version"),
        (data[:-5], "damaged"),
        (bytes(damaged), "damaged"),
        (others.snapshot(), "of other environments; their config should be as here"),
        (more.snapshot(), "their num_envs, max_episode_steps should"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.restore(bad)
        assert envs.snapshot() == data


def test_bad_resets_change_nothing():
    envs = batch(FAST, 2, CONFIG)
    envs.reset(seed=0)
    before = envs.snapshot()
    for arguments in (
        {"seed": [1]}, {"seed": -1}, {"options": {"reset_mask": np.zeros(2, bool)}},
        {"options": {"config": {}}}, {"options": "x"},
    ):  # fmt: skip
        with pytest.raises((ValueError, gym.error.Error)):
            envs.reset(**arguments)
        assert envs.snapshot() == before


def test_overflow_is_said():
    crowded = {"vehicles_count": 20, "vehicles_density": 3}
    envs = batch(FAST, 2, crowded, max_vehicles=2)
    with pytest.warns(UserWarning, match="max_vehicles=2: the 2 nearest are kept"):
        _, infos = envs.reset(seed=0)
    assert (infos["set"]["overflow"] == infos["set"]["count"] - 2).all()
    envs = batch(FAST, 2, crowded, max_vehicles=2, on_overflow="error")
    with pytest.raises(OverflowError, match="max_vehicles=2"):
        envs.reset(seed=0)


def test_a_route_that_leads_elsewhere_is_highway_envs_own_affair():
    """In mid-step, one ``follow_road`` in Python; beside a single environment in the same state."""
    envs = batch("esc_gym/roundabout-v0", 2, {})
    envs.reset(seed=4)
    env = envs.materialise(1)
    elsewhere = ("ne", "wx", None)
    vehicle = env.unwrapped.road.vehicles[1]
    vehicle.route = [vehicle.route[0], elsewhere]
    engine = envs.engine
    record, steps = engine.state.vehicles[1, 1], engine.state.routes[1, 1]
    record["route_length"] = 2
    steps[record["route_taken"] + 1] = engine.network.numbers["ne", "wx", 0], NO_LANE
    asked = []
    for step in range(6):
        ends = envs.step(np.array([1, 1]))[2:4]
        env.step(1)
        check(f"step {step}", snap(env, {}), snap(envs.materialise(1), {}))
        asked.append(len(env.unwrapped.road.vehicles[1].route))
        if ends[0][1] or ends[1][1]:
            break
    assert asked[-1] < 2  # it came to the end of its lane
