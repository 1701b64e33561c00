"""SB3 extractors, on a fake env of the size of a unit test."""

import copy
import os
import subprocess
import sys
from typing import Any

import numpy as np
import pytest
import torch
from gymnasium import spaces
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3

from esc_gym import extractors
from esc_gym.encoders import APEncoder, ESCEncoder
from esc_gym.extractors import REPRESENTATIONS, ESCExtractor, FPExtractor, SetExtractor
from esc_gym.matching import parameter_count
from tests.esc_gym.traffic import D1, D2, HIGH, N, Traffic, space

NAMED = {
    cls.representation: cls
    for cls in vars(extractors).values()
    if isinstance(cls, type) and issubclass(cls, SetExtractor) and cls is not SetExtractor
}
ALGORITHMS: dict[str, Any] = {
    "ppo": (PPO, False, {"n_steps": 8, "batch_size": 4, "n_epochs": 1}),
    "a2c": (A2C, False, {"n_steps": 4}),
    "dqn": (DQN, False, {"learning_starts": 4, "buffer_size": 32, "batch_size": 4}),
    "sac": (SAC, True, {"learning_starts": 4, "buffer_size": 32, "batch_size": 4}),
    "td3": (TD3, True, {"learning_starts": 4, "buffer_size": 32, "batch_size": 4}),
}


def model(algorithm: str, extractor: type[SetExtractor], share: bool | None = None, **kwargs):
    cls, continuous, settings = ALGORITHMS[algorithm]
    policy: dict[str, Any] = {
        "features_extractor_class": extractor,
        "features_extractor_kwargs": {"hidden": (8, 8), **kwargs},
        "net_arch": [8],
    }
    if share is not None:
        policy["share_features_extractor"] = share
    return cls(
        "MultiInputPolicy", Traffic(continuous), policy_kwargs=policy, seed=0, device="cpu",
        **settings,
    )  # fmt: skip


def weights(learner) -> dict[str, torch.Tensor]:
    """Copies of the encoders' weights, target networks' included."""
    state = learner.policy.state_dict()
    return {name: value.clone() for name, value in state.items() if ".encoder." in name}


def test_every_representation_has_a_named_extractor():
    assert set(NAMED) == set(REPRESENTATIONS)
    for name, cls in NAMED.items():
        assert cls.__name__.lower() == f"{name}extractor".replace("-", "")
        assert type(cls(space()).encoder) is REPRESENTATIONS[name]


@pytest.mark.parametrize("name", sorted(NAMED))
def test_forward_is_the_encoder_on_sb3_tensors(name):
    extractor = NAMED[name](space())
    sample = {key: torch.as_tensor(v)[None].float() for key, v in space().sample().items()}
    output = extractor(sample)
    assert output.shape == (1, extractor.features_dim) == (1, N * D1 + 1 + D2)
    expected = extractor.encoder(sample["vehicles"], sample["mask"], sample["ego"])
    torch.testing.assert_close(output, expected, rtol=0, atol=0)


@pytest.mark.parametrize("name", sorted(NAMED))
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_learns_with_every_representation(algorithm, name):
    learner = model(algorithm, NAMED[name])
    before = weights(learner)
    learner.learn(16)
    after = weights(learner)
    assert before.keys() == after.keys()
    assert any(not torch.equal(before[key], after[key]) for key in before)
    assert all(value.isfinite().all() for value in after.values())


@pytest.mark.parametrize(
    ("algorithm", "share"),
    [("ppo", False), ("a2c", True), ("a2c", False), ("dqn", None), ("sac", True), ("td3", True),
     ("td3", False)],
)  # fmt: skip
def test_learns_with_every_algorithm_shared_or_not(algorithm, share):
    learner = model(algorithm, ESCExtractor, share)
    before = weights(learner)
    learner.learn(16)
    assert any(not torch.equal(before[key], value) for key, value in weights(learner).items())


@pytest.mark.parametrize("name", sorted(NAMED))
def test_deepcopy_is_independent_and_equal(name):
    extractor = NAMED[name](space())
    twin = copy.deepcopy(extractor)
    sample = {key: torch.as_tensor(v)[None].float() for key, v in space().sample().items()}
    expected = extractor(sample)
    torch.testing.assert_close(twin(sample), expected, rtol=0, atol=0)
    for parameter in twin.parameters():
        torch.nn.init.zeros_(parameter)
    torch.testing.assert_close(extractor(sample), expected, rtol=0, atol=0)


def test_named_extractors_match_the_parameters_of_esc():
    esc = parameter_count(ESCExtractor(space(), hidden=(64, 64)))
    for cls in NAMED.values():
        assert abs(parameter_count(cls(space(), hidden=(64, 64))) - esc) <= 0.05 * esc
    plain = FPExtractor(space(), hidden=(64, 64), match_parameters=False)
    assert plain.encoder.hidden == (64, 64)
    assert ESCExtractor(space()).encoder.hidden == (128, 128)


def test_representation_by_name_path_and_arguments():
    assert isinstance(SetExtractor(space()).encoder, ESCEncoder)
    extractor = SetExtractor(space(), "esc_gym.encoders:APEncoder", slots=2)
    assert isinstance(extractor.encoder, APEncoder)
    assert extractor.encoder.slots == 2
    with pytest.warns(UserWarning, match="code_dim=5") as caught:
        assert ESCExtractor(space(), code_dim=5).features_dim == 5 + D2
    assert len(caught) == 1


@pytest.mark.parametrize("name", ["ap", "fp"])
def test_bounds_of_the_space_set_the_virtual_vehicle_and_distances(name):
    half = spaces.Box(-2 * HIGH * np.ones((N, 1)), HIGH * np.ones((N, 1)), (N, D1), np.float64)
    encoder: Any = NAMED[name](space(vehicles=half)).encoder
    assert encoder.virtual.tolist() == [1.0, -2.5, 0.0]
    assert encoder.center.tolist() == [-0.5, -2.5]
    assert encoder.reach.tolist() == [1.5, 7.5]


LOAD = """
import sys, numpy as np, torch
from stable_baselines3 import PPO
observation = dict(np.load(sys.argv[1]))
for path in sys.argv[2:]:
    model = PPO.load(path, device="cpu")
    with torch.no_grad():
        tensors, _ = model.policy.obs_to_tensor(observation)
        print(*model.policy.get_distribution(tensors).distribution.logits.flatten().tolist())
"""


def test_saved_models_load_in_a_new_process(tmp_path):
    names = ("esc", "fp", "attention")
    observation = Traffic().reset(seed=3)[0]
    np.savez(tmp_path / "observation.npz", **observation)
    expected = []
    for name in names:
        learner = model("ppo", NAMED[name])
        learner.save(tmp_path / f"{name}.zip")
        with torch.no_grad():
            tensors, _ = learner.policy.obs_to_tensor(observation)
            logits = learner.policy.get_distribution(tensors).distribution.logits
        expected.append(pytest.approx(logits.flatten().tolist(), rel=1e-5))
    files = ("observation.npz", *(f"{name}.zip" for name in names))
    done = subprocess.run(
        [sys.executable, "-c", LOAD, *files],
        cwd=tmp_path, capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    lines = done.stdout.splitlines()
    assert [[float(value) for value in line.split()] for line in lines] == expected


@pytest.mark.parametrize(
    "wrong",
    [
        spaces.Box(-1, 1, (N, D1), np.float32),
        spaces.Dict(ego=spaces.Box(-1, 1, (D2,)), vehicles=spaces.Box(-1, 1, (N, D1))),
        space(mask=spaces.MultiBinary(N + 1)),
        space(mask=spaces.Box(0, 1, (N,), np.float32)),
        space(ego=spaces.Box(-1, 1, (1, D2), np.float32)),
        space(vehicles=spaces.Box(-1, 1, (N * D1,), np.float32)),
        space(vehicles=spaces.Discrete(3)),
    ],
)
def test_other_spaces_are_refused(wrong):
    with pytest.raises(
        ValueError, match=r"got (Box|\{.*\}); wrap the env with esc_gym.SetObservation"
    ):
        ESCExtractor(wrong)


def test_unknown_representation_is_refused():
    with pytest.raises(ValueError, match="expected one of esc, esc-exp, fp, ap"):
        SetExtractor(space(), "ecs")
