"""policy.safetensors and policy.json: the same policy, from numbers and names alone."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest
import torch
from gymnasium import spaces
from safetensors.torch import load_file
from stable_baselines3 import PPO, SAC

from esc_agents.driving.environments import make_env
from esc_agents.driving.policies import BoxSpace, load_policy
from esc_agents.errors import UserError
from esc_agents.training.run_directory import open_run
from esc_agents.training.train import train
from tests.esc_agents.tiny import tiny


@pytest.mark.parametrize(("fixture", "algorithm"), [("ppo_run", PPO), ("sac_run", SAC)])
def test_the_same_policy_as_in_the_zip(fixture, algorithm, request, monkeypatch):
    path = request.getfixturevalue(fixture)
    model = algorithm.load(path / "model.zip", device="cpu")
    for module in (pickle, torch):  # no unpickling
        monkeypatch.setattr(module, "load", None)
    monkeypatch.setattr(pickle, "loads", None)
    policy, steps = load_policy(path)
    assert steps == model.num_timesteps
    assert policy.observation_space == model.observation_space
    assert policy.action_space == model.action_space
    env = make_env(open_run(path))
    observation, _ = env.reset(seed=1)
    for _ in range(5):
        action, _ = policy.predict(observation, deterministic=True)
        np.testing.assert_array_equal(action, model.predict(observation, deterministic=True)[0])
        observation, *_ = env.step(action)
    theirs = model.policy.state_dict()
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, theirs[name]), name


def test_every_tensor_once(ppo_run):
    """SB3 knows a shared extractor by three names."""
    stored = load_file(ppo_run / "policy.safetensors")
    policy = PPO.load(ppo_run / "model.zip", device="cpu").policy
    assert sum(tensor.numel() for tensor in stored.values()) == sum(
        parameter.numel() for parameter in policy.parameters()
    )
    assert len(stored) < len(policy.state_dict())


def test_the_description_is_for_people_too(ppo_run):
    described = json.loads((ppo_run / "policy.json").read_text())
    assert described["observation"] == json.loads((ppo_run / "wrapper.json").read_text())
    assert described["action"] == {"type": "discrete", "n": 5}
    assert described["net_arch"] == [8]
    assert np.shape(described["vehicles"]["low"]) == (7,)  # not once more for every row
    assert described["versions"]["torch"] == torch.__version__


def rewrite(path, change):
    values = json.loads((path / "policy.json").read_text())
    change(values)
    (path / "policy.json").write_text(json.dumps(values))


def test_sizes_do_not_follow_from_n(tmp_path):
    """Widths matched to ESC's, and d3 = N*d1 + 1: of the N in training, whatever is read later."""
    encoder = {"hidden": (32, 32)}
    assert train(tiny(repr="attention", run_dir=tmp_path / "run", encoder=encoder))
    weights = load_policy(tmp_path / "run")[0].state_dict()

    def more(values):
        values["vehicles"]["shape"][0] = 50

    def unresolved(values):  # as it was written once
        values["encoder"] = {"representation": "attention", "hidden": [32, 32], "code_dim": None}

    rewrite(tmp_path / "run", more)
    larger = load_policy(tmp_path / "run")[0]
    assert larger.observation_space["vehicles"].shape == (50, 7)
    rewrite(tmp_path / "run", unresolved)
    with pytest.raises(UserError, match="does not describe the weights"):
        load_policy(tmp_path / "run")
    rewrite(tmp_path / "run", lambda values: values["vehicles"]["shape"].__setitem__(0, 6))
    for policy in (larger, load_policy(tmp_path / "run")[0]):
        assert all(torch.equal(value, weights[k]) for k, value in policy.state_dict().items())


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (3,)),
        spaces.Box(np.float32([[0, -2], [0, -2]]), np.float32([[1, 3], [1, 4]])),
        spaces.Box(np.float32([0, 1]), np.float32([2, 2])),
    ],
)
def test_boxes_come_back(space):
    again = BoxSpace.model_validate_json(BoxSpace.of(space).model_dump_json()).build()
    assert again == space


def test_a_class_that_the_reader_does_not_have(own_run):
    """A description can name a class of the reader's own; it cannot bring one."""
    rewrite(own_run, lambda values: values["encoder"].update(representation="no_such_module:Class"))
    with pytest.raises(UserError, match="no_such_module"):
        load_policy(own_run)
