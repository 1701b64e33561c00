"""SAC learns parking from goals that were reached by chance, and goes on exactly after a kill."""

from __future__ import annotations

import numpy as np
import pytest
from stable_baselines3 import HerReplayBuffer

from esc_agents.driving.checks import check
from esc_agents.driving.environments import make_env
from esc_agents.driving.policies import load_policy
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.errors import UserError
from esc_agents.training import callbacks, run_directory
from esc_agents.training.models import new_model
from esc_agents.training.train import train
from tests.esc_agents.tiny import SAC, tiny
from tests.esc_agents.training.test_resume import SAME, Killed, kill

HER = {**SAC, "hindsight": True, "learning_starts": 20, "train_freq": 1}


def config(**changes):
    """Episodes of two seconds, ten steps."""
    values = {
        "algo": "sac", "env_config": {"duration": 2}, "observation": {"goal": True}, "sac": HER,
        "steps": 120, "checkpoint_every": 30, "evaluation": {"episodes": 2, "every": 48},
        "continuous": {"env_config": {"collision_reward": -50}}, **changes,
    }  # fmt: skip
    return tiny("parking-v0", **values)


@pytest.mark.parametrize("vec", ["dummy", "batch"])
def test_killed_and_resumed(vec, tmp_path, monkeypatch):
    assert train(config(vec=vec, run_dir=tmp_path / "whole"))
    kill(monkeypatch, callbacks.DrivingLog, "_on_step", 43)
    with pytest.raises(Killed):
        train(config(vec=vec, run_dir=tmp_path / "run"))
    monkeypatch.undo()
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    for name in SAME:
        whole, resumed = ((tmp_path / run / name).read_bytes() for run in ("whole", "run"))
        assert whole == resumed, name
    policy, _ = load_policy(tmp_path / "run")
    observation, _ = make_env(config()).reset(seed=0)
    assert np.abs(policy.predict(observation)[0]).max() <= 1


def test_it_learns_from_other_goals():
    envs = vectorise(config(), 2)
    try:
        assert isinstance(new_model(config(), envs).replay_buffer, HerReplayBuffer)
    finally:
        envs.close()


def test_a_collision_costs_what_it_costs_whatever_the_goal():
    envs = vectorise(config(env_config={"duration": 30}), 2)
    with closing(envs):
        buffer = new_model(config(), envs).replay_buffer
        rng, crashed = np.random.default_rng(0), {}
        seen = envs.reset()
        for _ in range(400):  # full throttle
            actions = np.stack([[1.0, rng.uniform(-1, 1)] for _ in range(2)]).astype(np.float32)
            after, rewards, dones, infos = envs.step(actions)
            # Where an episode ends, what is seen is the next one's beginning.
            last = {name: part.copy() for name, part in after.items()}
            for e in np.flatnonzero(dones):
                for name, part in infos[e]["terminal_observation"].items():
                    last[name][e] = part
            buffer.add(seen, last, actions, rewards, dones, infos)
            for e, info in enumerate(infos):
                crashed[last["achieved_goal"][e].tobytes()] = info["crashed"]
            seen = after
        sample = buffer.sample(3000)
        reached = sample.next_observations["achieved_goal"].numpy()
        wanted = sample.observations["desired_goal"].numpy()
        (of_goal,) = envs.env_method("compute_reward", reached, wanted, [{}] * 3000, indices=[0])
        hit = np.array([crashed[goal.tobytes()] for goal in reached])
        assert hit.sum() > 20
        np.testing.assert_allclose(sample.rewards[:, 0], of_goal - 50 * hit, atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"observation": {}}, "sac.hindsight: expected observation.goal true, got false"),
        ({"sac": {**HER, "learning_starts": 19}}, "sac.learning_starts: expected at least 20"),
        (
            {"sac": {**HER, "train_env_config": {"duration": 1000}}},
            "sac.learning_starts: expected at least",
        ),
    ],
)
def test_mistakes(changes, message):
    with pytest.raises(UserError, match=message):
        check(config(**changes))
