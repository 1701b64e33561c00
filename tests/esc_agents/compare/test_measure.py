"""What is measured of policies, on scripted ones and against counting by hand."""

from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from highway_env.envs.highway_env import HighwayEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from esc_agents.compare import measure
from esc_agents.compare.measure import (
    OrderProbe,
    SlotChurn,
    baselines,
    drive,
    encoder_of,
    examine,
    shuffled,
)
from esc_agents.driving.environments import make_env
from esc_agents.driving.episodes import Summary, evaluate
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError
from esc_agents.training.train import train
from esc_gym.encoders import FPEncoder
from tests.esc_agents.tiny import ROAD, SAC_RUN, tiny


def sets(*counts: int, rows: int = 6) -> dict[str, Any]:
    """Batches of sets whose rows are numbered."""
    mask = (np.arange(rows) < np.array(counts)[:, None]).astype(np.int8)
    vehicles = np.zeros((len(counts), rows, 2), np.float32)
    vehicles[..., 0] = np.arange(1, rows + 1) * mask
    return {"vehicles": vehicles, "mask": mask, "ego": np.zeros((len(counts), 1), np.float32)}


@pytest.mark.parametrize("counts", [(0,), (1,), (6,), (2, 5, 0, 6)])
def test_shuffled_sets_hold_the_same_vehicles(counts):
    before = sets(*counts)
    after = shuffled(before, np.random.default_rng(0))
    for one, two in zip(before["vehicles"], after["vehicles"], strict=True):
        assert sorted(one[:, 0]) == sorted(two[:, 0])
    np.testing.assert_array_equal(after["vehicles"][..., 0] > 0, before["mask"])  # padding stays
    assert np.array_equal(before["vehicles"], sets(*counts)["vehicles"])  # and is left alone


def test_shuffling_gives_every_order():
    generator = np.random.default_rng(0)
    seen = {tuple(shuffled(sets(3), generator)["vehicles"][0, :3, 0]) for _ in range(100)}
    assert len(seen) == 6


def scripted(act, features) -> Any:
    """Something that is to OrderProbe what an SB3 policy is."""
    return SimpleNamespace(
        predict=lambda o, deterministic: (act(o["vehicles"]), None), features_extractor=features
    )


def test_order_probe_of_a_policy_that_looks_at_the_first_vehicle():
    policy = scripted(lambda v: v[:, 0, 0].astype(int), lambda o: o["vehicles"][:, 0])
    probe = OrderProbe(policy, 0, lambda: [False])
    for count in (2, 1, 2, 1) * 100:
        assert probe(sets(count)) == [1]
    effect = probe.effect()
    # Of two vehicles the second comes first half of the time; one vehicle has one order.
    assert effect.decisions == 400
    assert 0.18 < effect.changed < 0.32
    assert effect.features == 1.0  # 2 instead of 1, where the largest is 1


def test_order_probe_of_a_policy_that_sums():
    policy = scripted(lambda v: v.sum(axis=(1, 2)) / 10, lambda o: o["vehicles"].sum(dim=1))
    probe = OrderProbe(policy, 0, lambda: [False])
    for count in (5, 3, 0):
        probe(sets(count))
    assert probe.effect().changed == pytest.approx(0, abs=1e-6)
    assert probe.effect().features == pytest.approx(0, abs=1e-6)


def test_order_probe_counts_continuous_changes_by_size():
    policy = scripted(lambda v: v[:, 0, :1] * 0.25, lambda o: o["vehicles"][:, 0])
    probe = OrderProbe(policy, 0, lambda: [False])
    for count in (2, 3) * 200:
        probe(sets(count))
    # Of two: by 0.25 half of the time; of three: by 0.25 or 0.5, a third each.
    assert probe.effect().changed == pytest.approx((0.125 + 0.25) / 2, rel=0.15)


def test_order_probe_does_not_count_a_resting_environment():
    policy = scripted(lambda v: v[:, 0, 0].astype(int), lambda o: o["vehicles"][:, 0])
    probe = OrderProbe(policy, 0, lambda: [False, True])
    for _ in range(50):
        probe(sets(1, 2))
    assert (probe.effect().decisions, probe.effect().changed) == (50, 0)


class Passing(gym.Env):
    """One-dimensional traffic from a list: at each step the ids and their x, in that order."""

    observation_space = gym.spaces.Dict(
        ego=gym.spaces.Box(-1, 1, (1,)),
        vehicles=gym.spaces.Box(-1, 1, (3, 2)),
        mask=gym.spaces.MultiBinary(3),
    )
    action_space = gym.spaces.Discrete(2)

    def __init__(self, *moments):
        self.moments = moments

    def reset(self, *, seed=None, options=None):
        self.left = list(self.moments)
        return self._observation()

    def _observation(self):
        near = self.left.pop(0)
        vehicles, mask = np.zeros((3, 2), np.float32), np.zeros(3, np.int8)
        vehicles[: len(near), 0], mask[: len(near)] = list(near.values()), 1
        ids = {"set": {"ids": tuple(near)}}
        return {"ego": np.zeros(1, np.float32), "vehicles": vehicles, "mask": mask}, ids

    def step(self, action):
        return self._observation()[0], 0.0, not self.left, False, {}


class PassingWithIds(Passing):
    def step(self, action):
        observation, info = self._observation()
        return observation, 0.0, not self.left, False, info


def churn_of(slots, *moments):
    encoder = FPEncoder(vehicle_dim=2, ego_dim=1, max_vehicles=3, slots=slots)
    envs = SlotChurn(DummyVecEnv([lambda: PassingWithIds({9: 0.5}, *moments)]), encoder)
    envs.reset()
    for _ in moments:
        envs.step(np.array([0]))
    return envs


def test_churn_counts_slots_that_change_hands():
    near = ({7: 0.1, 8: 0.2}, {7: 0.3, 8: 0.2}, {8: 0.1, 5: 0.2, 7: 0.4}, {}, {})
    envs = churn_of(3, *near)
    # By distance: (7, 8), (8, 7), (8, 5, 7), (): two of two change, then one of two, then none is
    # left. The last moment ends the episode; the first follows no other.
    assert (envs.changed, envs.total, envs.rate()) == (3, 4, 0.75)
    envs = churn_of(1, *near)
    assert (envs.changed, envs.total) == (1, 2)


def test_churn_is_that_of_slots():
    encoder: Any = SimpleNamespace()
    assert SlotChurn(DummyVecEnv([lambda: Passing({1: 0.1})]), encoder).rate() is None


@pytest.fixture(scope="module")
def policies(tmp_path_factory, sac_run):
    """ESC's and FP's after a little PPO, and SAC's."""
    found = {}
    for repr, arguments in {"esc": {}, "fp": {"slots": 4}}.items():
        folder = tmp_path_factory.mktemp("runs") / repr
        encoder = {"hidden": (8,), "code_dim": 200, "arguments": arguments}
        config = tiny(repr=repr, run_dir=folder, encoder=encoder)
        train(config)
        found[repr] = config, folder
    sac = tiny("lane-keeping-v0", algo="sac", run_dir=sac_run, **SAC_RUN)
    return {**found, "sac": (sac, sac_run)}


def test_a_drive_is_the_evaluation(policies):
    config, folder = policies["esc"]
    policy = load_policy(folder)[0]
    episodes, order, churn = examine(config, policy, range(5))
    assert [e.seed for e in episodes] == list(range(5))
    assert order.decisions == sum(e.length for e in episodes)
    assert order.features < 1e-5
    assert churn is None
    assert drive(config, policy, range(5)) == episodes


@pytest.mark.parametrize("repr", ["esc", "fp"])
def test_a_policy_drives_among_more_vehicles_than_it_was_trained_with(policies, repr):
    config, folder = policies[repr]
    policy = load_policy(folder)[0]
    more = config.model_copy(update={"env_config": {**ROAD, "vehicles_count": 12}})
    assert make_env(more).observation_space["vehicles"].shape[0] == 12  # type: ignore[index]
    episodes, order, churn = examine(more, policy, range(3))
    assert len(episodes) == 3
    assert order.features < 1e-5
    assert (churn is None) == (repr == "esc")
    again = drive(config, policy, range(3))  # and again among fewer
    assert again == drive(config, load_policy(folder)[0], range(3))


def test_continuous_policies_are_measured_too(policies):
    config, folder = policies["sac"]
    policy = load_policy(folder)[0]
    assert encoder_of(policy) is policy.actor.features_extractor.encoder
    episodes, order, _ = examine(config, policy, range(2))
    assert len(episodes) == 2
    assert order.changed == pytest.approx(0, abs=1e-6)  # nobody else is on that road


def test_baselines_are_the_floors_and_the_rule_driver():
    config = tiny()
    seeds = range(700, 704)
    found = baselines(config, 700, 4)
    slower = DummyVecEnv([lambda: make_env(config, evaluation=True)])
    assert found.blind["always SLOWER"] == Summary.of(
        evaluate(slower, lambda observations: np.array([4]), seeds)
    )
    envs = DummyVecEnv([lambda: make_env(config, evaluation=True, rule_driver=True)])
    anything = evaluate(envs, lambda observations: np.array([0]), seeds)
    rewards = [episode.reward for episode in anything]
    assert found.rule.reward == pytest.approx(np.mean(rewards))
    assert found.missing == {}


def test_a_baseline_that_fails_loses_only_its_row(monkeypatch):
    def reward(self, action):
        if action == 4 and self.time > 1:  # a probe makes one step, with any action
            raise ZeroDivisionError("slow")
        return 1.0

    monkeypatch.setattr(HighwayEnv, "_reward", reward)
    found = baselines(tiny(), 0, 2)
    others = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER")
    assert {f"always {action}" for action in others} <= found.blind.keys()
    assert found.rule.reward == found.rule.length
    assert "always SLOWER" not in found.blind
    assert found.missing["always SLOWER"].endswith("step 2: ZeroDivisionError: slow")


def test_a_rule_driver_that_fails_loses_only_its_row(monkeypatch):
    def broken(*arguments):
        raise AttributeError("'IDMVehicle' object has no attribute 'wings'")

    monkeypatch.setattr(measure, "rule_driver", broken)
    found = baselines(tiny(), 0, 1)
    assert len(found.blind) == 6
    assert found.rule is None
    why = "AttributeError: 'IDMVehicle' object has no attribute 'wings'"
    assert found.missing == {"IDM/MOBIL": why}


def test_without_any_floor_the_reason_is_an_error(monkeypatch):
    monkeypatch.setattr(measure, "blind_drives", lambda *arguments: {"random": lambda: 1 / 0})
    with pytest.raises(UserError, match="no blind policy could drive: ZeroDivisionError: division"):
        baselines(tiny(), 0, 1)
