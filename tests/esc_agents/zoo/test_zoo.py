"""Agents that come with the package: they load without pickles, drive, and can be gone on from."""

from __future__ import annotations

import re
import shlex

import numpy as np
import pytest
import torch

from esc_agents import pretrained, zoo
from esc_agents.cli import eval as eval_cli, keep as keep_cli, train as train_cli
from esc_agents.config import TrainConfig
from esc_agents.driving.environments import make_env, wrapper_json
from esc_agents.driving.policies import load_policy, start_from
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError
from esc_agents.training import run_directory, train as training
from esc_agents.training.models import new_model
from tests.esc_agents.tiny import PPO, RANGES, tiny


@pytest.fixture
def own_zoo(tmp_path, monkeypatch):
    """An empty zoo."""
    monkeypatch.setattr(pretrained, "folder", lambda: tmp_path / "zoo")


@pytest.mark.parametrize("name", zoo.names())
def test_every_agent_drives(name):
    agent = zoo.load(name)
    env = agent.make_env()
    observation, _ = env.reset(seed=0)
    for _ in range(3):
        action, _ = agent.predict(observation)
        observation, reward, terminated, truncated, _ = env.step(action)
        assert np.isfinite(reward)
        if terminated or truncated:
            break
    assert agent.steps >= agent.config.steps


@pytest.mark.parametrize("name", zoo.names())
def test_what_a_card_says_still_trains_its_agent(name, monkeypatch):
    """Of recipes that were changed since, too."""
    card = (pretrained.directory(name) / "README.md").read_text()
    (again,) = re.findall("Again: `(.*)`", card)
    program, *words = shlex.split(again.rpartition(" && ")[2])
    if program == "esc-imitate":
        pytest.skip("its configuration says all but what it imitated")
    asked: list[TrainConfig] = []
    monkeypatch.setattr(training, "train", lambda config, **_: asked.append(config) or True)
    assert (program, train_cli.command(words)) == ("esc-train", 0)
    kept = run_directory.open_run(pretrained.directory(name))
    for field in ("env", "repr", "algo", "steps", "seed", "n_envs", "env_config", "start_from",
                  "observation", "hyperparameters"):  # fmt: skip
        assert getattr(asked[0], field) == getattr(kept, field), field


def test_a_run_is_kept_and_evaluated(ppo_run, own_zoo, call):
    code, out, _ = call(keep_cli, ppo_run, "--name", "tiny")
    assert code == 0
    assert "tiny" in out
    assert zoo.names() == ["tiny"]
    code, kept, _ = call(eval_cli, "--pretrained", "tiny", "--episodes", "2")
    assert code == 0
    _, own, _ = call(eval_cli, ppo_run, "--episodes", "2")
    assert kept == own


def test_what_the_zoo_does_not_have(ppo_run, own_zoo, call):
    call(keep_cli, ppo_run, "--name", "tiny")
    code, _, err = call(eval_cli, "--pretrained", "tine")
    assert code == 2
    assert "did you mean 'tiny'?" in err
    for arguments, count in (([], "none"), ([ppo_run, "--pretrained", "tiny"], "2")):
        code, _, err = call(eval_cli, *arguments)
        assert code == 2
        assert err == (
            "esc-eval: expected a run directory, or --pretrained NAME (there are: tiny), or "
            f"--expert NAME, got {count} of them\n"
        )


@pytest.mark.parametrize("name", ["..", "", ".", "a/b", "Dense", "dense-"])
def test_a_name_that_leads_elsewhere_is_refused(name, ppo_run, own_zoo, call, tmp_path):
    beside = tmp_path / "beside"
    beside.touch()
    code, _, err = call(keep_cli, ppo_run, "--name", name)
    assert (code, err.count("\n")) == (2, 1)
    assert "name: expected words" in err
    assert beside.exists()
    assert zoo.names() == []


def test_what_is_no_finished_run_is_not_kept(own_zoo, own_run, call, tmp_path):
    code, _, err = call(keep_cli, tmp_path / "none", "--name", "tiny")
    assert code == 2
    assert "is no run directory" in err
    (own_run / "SHA256SUMS").unlink()
    code, _, err = call(keep_cli, own_run, "--name", "tiny")
    assert code == 2
    assert "is not finished" in err
    assert zoo.names() == []


def begun(folder, **changes):
    """An untrained policy that was given the weights of a run; and its weights before."""
    config = tiny(**changes)
    envs = vectorise(config, 1)
    try:
        policy = new_model(config, envs).policy
        before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
        observation = wrapper_json(make_env(config))
        error = None
        try:
            start_from(policy, str(folder), config.algo, observation)
        except UserError as refused:
            error = str(refused)
        return policy, before, error
    finally:
        envs.close()


def test_a_run_begins_with_the_weights_of_another(ppo_run):
    policy, _, error = begun(ppo_run, seed=5)
    assert error is None
    expected = load_policy(ppo_run)[0].state_dict()
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, expected[name]), name


OTHERWISE = {
    "ranges": {"observation": {"ranges": {**RANGES, "x": (-50, 50)}}},
    "features": {"observation": {"ranges": RANGES, "features": ("x", "y", "vx", "vy")}},
    "got representation esc there and esc-exp here": {"repr": "esc-exp"},
    "the same network": {"ppo": {**PPO, "net_arch": (9,)}},
    "the actions": {
        "env_config": {"action": {"type": "DiscreteMetaAction", "lateral": False}},
    },
}


@pytest.mark.parametrize("what", OTHERWISE)
def test_weights_that_do_not_fit_are_refused(what, ppo_run):
    policy, before, error = begun(ppo_run, **OTHERWISE[what])
    assert error is not None
    assert what in error
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, before[name]), name


def test_esc_train_starts_from_a_run(ppo_run, own_zoo, call, tmp_path):
    call(keep_cli, ppo_run, "--name", "tiny")
    config = ppo_run / "config.yaml"
    for source in (ppo_run, "zoo:tiny"):
        run = tmp_path / str(source).replace("/", "-")
        code, out, _ = call(train_cli, "--config", config, "--start-from", source, "--run-dir", run)
        assert code == 0
        assert "Beginning with the weights of" in out
    code, _, err = call(train_cli, "--config", config, "--start-from", tmp_path / "none")
    assert code == 2
    assert "none is no run directory: expected policy.json in it; train that run first" in err
    assert not (tmp_path / "runs").exists()
