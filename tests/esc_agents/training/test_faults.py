"""What goes wrong in environments and updates: said at once, with the place, nothing lost."""

from __future__ import annotations

import json

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3.common.vec_env import SubprocVecEnv

from esc_agents import files
from esc_agents.driving.environments import EnvFactory
from esc_agents.driving.episodes import check_faults
from esc_agents.driving.vectorised import vectorise
from esc_agents.driving.wrappers import Worker
from esc_agents.errors import UserError
from esc_agents.training import callbacks, run_directory
from esc_agents.training.checkpoint import in_order
from esc_agents.training.train import train
from esc_gym.observation import SetObservation
from tests.esc_agents.tiny import tiny

real_step = SetObservation.step


def broken_step(change, at=2):
    """A step that is ``change``d in every environment at its step number ``at``."""

    def step(self, action):
        observation, reward, terminated, truncated, info = real_step(self, action)
        self.steps_made = getattr(self, "steps_made", 0) + 1
        if self.steps_made == at:
            observation, reward = change(observation, reward)
        return observation, reward, terminated, truncated, info

    return step


def nan_in_vehicles(observation, reward):
    vehicles = observation["vehicles"].copy()
    vehicles[1, 2] = np.nan
    return {**observation, "vehicles": vehicles}, reward


def infinite_ego(observation, reward):
    return {**observation, "ego": np.full_like(observation["ego"], np.inf)}, reward


def fails(observation, reward):
    raise ZeroDivisionError("a custom road")


CHANGES = {
    "vehicle": (nan_in_vehicles, r"episode 0, step 2: 'vx' of vehicle 1 \(id \d+\) is nan"),
    "ego": (infinite_ego, r"episode 0, step 2: '\w+' of the ego is inf"),
    "reward": (lambda o, r: (o, float("-inf")), r"episode 0, step 2: the reward is -inf"),
    "exception": (fails, r"episode 0, step 2: ZeroDivisionError: a custom road"),
}


@pytest.mark.parametrize("name", CHANGES)
def test_environments(name, tmp_path, monkeypatch):
    change, message = CHANGES[name]
    monkeypatch.setattr(SetObservation, "step", broken_step(change))
    where = "highway-fast-v0, seed 0, step 4, environment 0, "
    with pytest.raises(UserError, match=where + message):
        train(tiny(run_dir=tmp_path / "run"))
    assert len(in_order(tmp_path / "run" / "checkpoints")) == 1


class Broken(gym.Wrapper):
    def step(self, action):
        raise ZeroDivisionError("a custom road")


def broken():
    return Worker(Broken(EnvFactory(tiny())().env))


def test_environments_in_processes():
    envs = SubprocVecEnv([EnvFactory(tiny()), broken])
    try:
        envs.reset()
        for _ in range(2):
            *_, infos = envs.step(np.ones(2, int))
            with pytest.raises(UserError, match="here, environment 1, episode 0, step 1: ZeroDiv"):
                check_faults(infos, "here")
    finally:
        envs.close()


def test_faults_of_a_reset_are_told_with_the_next_step(monkeypatch):
    def reset(self, **_):
        raise RuntimeError("no road")

    monkeypatch.setattr(SetObservation, "reset", reset)
    env = EnvFactory(tiny())()
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    for _ in range(2):
        *_, info = env.step(0)
        assert info["fault"] == "episode 0, step 0: RuntimeError: no road"


def test_in_evaluations_too(tmp_path, monkeypatch):
    monkeypatch.setattr(SetObservation, "step", broken_step(fails, at=2))
    monkeypatch.setattr(callbacks.Faults, "_on_step", lambda self: True)
    with pytest.raises(UserError, match=r"evaluation, environment 0, episode \d, step 2: ZeroDiv"):
        train(tiny(run_dir=tmp_path / "run"))


def test_a_state_goes_to_another_process_and_back():
    one, two = (Worker(EnvFactory(tiny())().env) for _ in range(2))
    one.reset(seed=3)
    one.step(1)
    two.restore(one.state())
    for _ in range(12):
        (a, *rest_a), (b, *rest_b) = one.step(1), two.step(1)
        assert all(np.array_equal(a[key], b[key]) for key in a)
        assert rest_a[:3] == rest_b[:3]
        if rest_a[1] or rest_a[2]:
            first, second = one.reset()[0], two.reset()[0]
            assert all(np.array_equal(first[key], second[key]) for key in first)
    assert (one.episode, one.steps) == (two.episode, two.steps)


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_weights_that_are_not_finite(algo, tmp_path, monkeypatch):
    env = "highway-fast-v0" if algo == "ppo" else "lane-keeping-v0"
    original = callbacks.Faults._on_rollout_start

    def poison(self):
        if self.num_timesteps >= 32:
            with torch.no_grad():
                next(iter(self.model.policy.parameters()))[0] = float("nan")
        original(self)

    monkeypatch.setattr(callbacks.Faults, "_on_rollout_start", poison)
    config = tiny(env, algo=algo, steps=64, checkpoint_every=16, run_dir=tmp_path / "run")
    with pytest.raises(UserError, match=r"step 32: after an update .*(weight|bias) is not finite"):
        train(config)
    monkeypatch.undo()
    last = in_order(tmp_path / "run" / "checkpoints")[-1]
    assert int(last.stem) < 32  # from before: it can be resumed
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")


def test_a_loss_that_is_not_finite(tmp_path, monkeypatch):
    original = callbacks.Faults._on_rollout_start

    def poison(self):
        if self.num_timesteps:
            self.logger.record("train/value_loss", float("inf"))
        original(self)

    monkeypatch.setattr(callbacks.Faults, "_on_rollout_start", poison)
    with pytest.raises(UserError, match=r"step 32: train/value_loss is inf"):
        train(tiny(steps=64, run_dir=tmp_path / "run"))


def test_weights_that_are_not_finite_after_the_last_update(tmp_path, monkeypatch):
    """The last checkpoint is from before it."""

    def poison(self):
        with torch.no_grad():
            next(iter(self.model.policy.parameters()))[0] = float("nan")

    monkeypatch.setattr(callbacks.DrivingLog, "_on_training_end", poison)
    with pytest.raises(UserError, match=r"step 32: after an update .*(weight|bias) is not finite"):
        train(tiny(steps=32, checkpoint_every=16, run_dir=tmp_path / "run"))
    assert [int(path.stem) for path in in_order(tmp_path / "run" / "checkpoints")] == [0]
    assert not (tmp_path / "run" / "policy.json").exists()


def test_people_who_stop_reading_are_no_process_that_died(tmp_path, monkeypatch):
    class Closed:
        def flush(self):
            raise BrokenPipeError

    monkeypatch.setattr("sys.stdout", Closed())
    with pytest.raises(BrokenPipeError), run_directory.said(tmp_path, "esc-train"):
        raise BrokenPipeError


def test_a_machine_without_git(monkeypatch):
    monkeypatch.setenv("PATH", "")
    assert files.versions()["python"]


@pytest.mark.slow
def test_a_worker_that_dies(tmp_path, monkeypatch):
    def die(self):
        if self.num_timesteps == 20:
            self.model.env.processes[0].kill()
        return True

    monkeypatch.setattr(callbacks.DrivingLog, "_on_step", die)
    with pytest.raises(UserError, match=r"process of an environment died.*--resume"):
        train(tiny(vec="subproc", run_dir=tmp_path / "run"))


def test_two_processes_in_one_directory(own_run):
    config = run_directory.open_run(own_run).model_copy(update={"steps": 64})
    with (
        run_directory.locked(own_run),
        pytest.raises(UserError, match="is in use by another process"),
    ):
        train(config, resume=own_run)


def test_a_directory_that_cannot_be_written(own_run, monkeypatch):
    def refuse(path, fill):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(files, "write_atomically", refuse)
    config = run_directory.open_run(own_run).model_copy(update={"steps": 64})
    with pytest.raises(UserError, match="Permission denied"):
        train(config, resume=own_run)


def test_a_disk_that_is_full_at_the_end(ppo_run, tmp_path, monkeypatch):
    config = tiny(run_dir=tmp_path / "run")
    real = files.write_atomically

    def full(path, fill):
        if path.name == "model.zip":
            raise OSError(28, "No space left on device", str(path))
        real(path, fill)

    monkeypatch.setattr(files, "write_atomically", full)
    with pytest.raises(UserError, match=r"model.zip: No space left on device; .*--resume"):
        train(config)
    monkeypatch.undo()
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    for name in ("policy.safetensors", "metrics.csv"):
        assert (tmp_path / "run" / name).read_bytes() == (ppo_run / name).read_bytes()


def test_policies_of_another_kind(own_run):
    described = own_run / "policy.json"
    values = json.loads(described.read_text())
    envs = vectorise(tiny(), 1)
    assert values["vehicles"]["shape"] == list(envs.observation_space["vehicles"].shape)
    for key, value, message in (
        ("net_arch", [9], r"policy.json does not describe the weights beside it"),
        ("algo", "dqn", r"policy.json is damaged or of another version: algo"),
        ("schema_version", 2, r"policy.json is damaged or of another version: schema_version"),
        ("spare", 1, r"spare"),
    ):
        described.write_text(json.dumps(values | {key: value}))
        with pytest.raises(UserError, match=message):
            load(own_run)
    described.write_text("{")
    with pytest.raises(UserError, match=r"policy.json is damaged"):
        load(own_run)


def load(path):
    from esc_agents.driving.policies import load_policy

    return load_policy(path)
