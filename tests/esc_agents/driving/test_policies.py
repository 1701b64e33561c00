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
    path = own_run / "policy.json"
    values = json.loads(path.read_text())
    values["encoder"]["representation"] = "no_such_module:Class"
    path.write_text(json.dumps(values))
    with pytest.raises(UserError, match="no_such_module"):
        load_policy(own_run)
