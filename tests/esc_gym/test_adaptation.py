"""A model in other traffic: the same weights, the same vehicles, the same decisions."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch
from gymnasium import spaces
from sb3_contrib import QRDQN, TQC, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DDPG, DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv

import esc_gym
from esc_gym.extractors import ESCExtractor, SetExtractor
from tests.esc_gym.traffic import D1, D2, N, Traffic, space

MANY, FEW = 9, 2
ON = {"n_steps": 8, "batch_size": 4}
ONCE = {"n_epochs": 1}
OFF = {"learning_starts": 4, "buffer_size": 32, "batch_size": 4}
ALGORITHMS: dict[Any, tuple[bool, dict[str, Any]]] = {
    PPO: (True, ON | ONCE), A2C: (False, {"n_steps": 4}), TRPO: (True, ON),
    MaskablePPO: (False, ON | ONCE), RecurrentPPO: (True, ON | ONCE), DQN: (False, OFF),
    QRDQN: (False, OFF), SAC: (True, OFF), TD3: (True, OFF), DDPG: (True, OFF), TQC: (True, OFF),
}  # fmt: skip
EVERY = {
    "esc": {}, "esc-exp": {}, "mean": {}, "max": {}, "attention": {}, "fp": {"slots": 3},
    "ap": {"slots": 3},
}  # fmt: skip


class Maskable(Traffic):
    def action_masks(self):
        return np.ones(2, bool)


def model(algorithm: Any, representation: str = "esc", **arguments: Any) -> Any:
    continuous, settings = ALGORITHMS[algorithm]
    policy: dict[str, Any] = {
        "features_extractor_class": SetExtractor,
        "features_extractor_kwargs": {
            "representation": representation, "hidden": (8, 8), **arguments,
        },
        "net_arch": [8],
    }  # fmt: skip
    name = "MultiInputPolicy"
    if algorithm is RecurrentPPO:
        name, policy["lstm_hidden_size"] = "MultiInputLstmPolicy", 8
    return algorithm(
        name, Maskable(continuous), policy_kwargs=policy, seed=0, device="cpu", **settings
    )


def env_like(model: Any, n: int, **parts: Any) -> gym.Env:
    return Maskable(isinstance(model.action_space, spaces.Box), n, **parts)


def sets(n: int) -> dict[str, np.ndarray]:
    """The same sets of none to two vehicles, padded to N = n."""
    generator = np.random.default_rng(0)
    vehicles, mask = np.zeros((30, n, D1), np.float32), np.zeros((30, n), np.int8)
    mask[:, :2] = np.arange(2) < np.arange(30)[:, None] % 3
    vehicles[:, :2] = generator.uniform(-1, 1, (30, 2, D1)) * mask[:, :2, None]
    ego = generator.uniform(-1, 1, (30, D2)).astype(np.float32)
    return {"ego": ego, "vehicles": vehicles, "mask": mask}


@torch.no_grad()
def seen(policy: Any, n: int) -> list[np.ndarray]:
    """What a policy makes of ``sets(n)``: its actions, and the features of each extractor."""
    tensors = {name: torch.as_tensor(values).float() for name, values in sets(n).items()}
    extractors = [part for part in policy.modules() if isinstance(part, SetExtractor)]
    actions = policy.predict(sets(n), deterministic=True)[0]
    return [actions, *(extractor(tensors).numpy() for extractor in extractors)]


def check_same(after: list[np.ndarray], before: list[np.ndarray]) -> None:
    for one, two in zip(after, before, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-6)


@pytest.mark.parametrize("n", [MANY, FEW])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_algorithm_goes_on(algorithm, n, tmp_path):
    learner = model(algorithm)
    learner.learn(8)
    learner.replay_buffer = None  # as after load
    before, weights = seen(learner.policy, N), learner.get_parameters()
    assert esc_gym.adapt(learner, env_like(learner, n)) is learner
    check_same(seen(learner.policy, n), before)
    torch.testing.assert_close(learner.get_parameters(), weights, rtol=0, atol=0)
    assert learner.num_timesteps == 8

    learner.learn(16, reset_num_timesteps=False)
    assert learner.num_timesteps == 24
    after = learner.policy.state_dict()
    assert any(not torch.equal(after[name], old) for name, old in weights["policy"].items())
    learner.save(tmp_path / "model.zip")
    again = algorithm.load(tmp_path / "model.zip", device="cpu")
    assert again.observation_space == space(n)
    check_same(seen(again.policy, n), seen(learner.policy, n))


@pytest.mark.parametrize("representation", EVERY)
def test_every_representation_of_any_size(representation, tmp_path):
    learner = model(PPO, representation, **EVERY[representation])
    before = seen(learner.policy, N)
    path = tmp_path / "model.zip"
    for n in (MANY, FEW, N):
        esc_gym.adapt(learner, env_like(learner, n)).save(path)
        learner = PPO.load(path, device="cpu")
        check_same(seen(learner.policy, n), before)
    assert learner.policy.features_extractor.encoder.code_dim == N * D1 + 1


def test_sizes_that_followed_from_n_are_pinned():
    learner = model(PPO, "attention")
    encoder = learner.policy.features_extractor.encoder
    assert encoder.hidden != (8, 8)  # matched to ESC's
    esc_gym.adapt(learner, env_like(learner, MANY))
    assert learner.policy_kwargs["features_extractor_kwargs"] == {
        "representation": "attention", "hidden": list(encoder.hidden), "code_dim": N * D1 + 1,
        "max_vehicles": N, "match_parameters": False,
    }  # fmt: skip


@pytest.mark.parametrize("algorithm", [PPO, DQN, SAC])
def test_a_bare_policy(algorithm, tmp_path):
    policy = model(algorithm).policy
    before = seen(policy, N)
    esc_gym.adapt(policy, DummyVecEnv([lambda: Traffic(algorithm is not DQN, MANY)]))
    check_same(seen(policy, MANY), before)
    policy.save(tmp_path / "policy.pth")
    check_same(seen(type(policy).load(tmp_path / "policy.pth"), MANY), before)


def test_another_number_of_environments():
    learner = model(RecurrentPPO)  # its buffer and its state know the number
    esc_gym.adapt(learner, DummyVecEnv([lambda: Traffic(True, MANY)] * 3))
    buffer = learner.learn(24).rollout_buffer
    assert buffer.observations["vehicles"].shape == (8 * 3, MANY, D1)


def test_what_is_left_behind_is_said_and_the_logger_stays():
    learner = model(SAC).learn(8)
    logger = learner.logger
    learner.set_logger(logger)
    with pytest.warns(UserWarning, match="the 8 transitions in the replay buffer"):
        esc_gym.adapt(learner, env_like(learner, MANY))
    assert learner.replay_buffer.size() == 0
    assert learner.learn(8).logger is logger


FAR = {"vehicles": spaces.Box(-2, 2, (MANY, D1), np.float32)}
WIDE = {"vehicles": spaces.Box(-1, 1, (MANY, D1 + 1), np.float32)}


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (Traffic(True, MANY, ego=spaces.Box(-1, 1, (5,))), "ego features: expected 2, .* got 5"),
        (Traffic(True, MANY, ego=spaces.Box(-1, 2, (2,))), r"ranges of the ego: .*\[2.0, 2.0\]"),
        (Traffic(True, MANY, **WIDE), "vehicle features: expected 3, .* got 4"),
        (Traffic(True, MANY, **FAR), r"ranges of vehicles: expected \[\[-1.0, -5.0, .* got \[\[-2"),
        (Traffic(False, MANY), r"actions: expected Box.* got Discrete\(2\)"),
        (gym.make("CartPole-v1"), "wrap the env with esc_gym.SetObservation"),
    ],
)
def test_environments_that_differ_in_more_than_n_are_refused(env, message):
    learner = model(PPO)
    before = seen(learner.policy, N)
    with pytest.raises(ValueError, match=message):
        esc_gym.adapt(learner, env)
    check_same(seen(learner.policy, N), before)


@pytest.mark.parametrize("representation", ["fp", "ap"])
def test_slots_that_are_rows_are_refused(representation):
    learner = model(PPO, representation)
    with pytest.raises(ValueError, match=r"expected N = 4, .* got 9; .* with slots=Z"):
        esc_gym.adapt(learner, env_like(learner, MANY))
    esc_gym.adapt(learner, env_like(learner, N))  # as set_env


def test_other_extractors_are_refused():
    learner = PPO("MultiInputPolicy", Traffic(True), device="cpu")
    with pytest.raises(ValueError, match=r"expected one with a features .* got CombinedExtractor"):
        esc_gym.adapt(learner, Traffic(True, MANY))


def test_a_model_of_sb3_alone_in_denser_traffic(tmp_path):
    """The README's lines."""
    fewer, more = (
        gym.make("esc_gym/highway-fast-v0", config={"vehicles_count": n, "duration": 5})
        for n in (6, 25)
    )
    extractor = {"features_extractor_class": ESCExtractor}
    trained = PPO(
        "MultiInputPolicy", fewer, policy_kwargs=extractor, device="cpu", n_steps=64, n_epochs=1
    )
    trained.save(tmp_path / "model.zip")
    learner = PPO.load(tmp_path / "model.zip", device="cpu")
    observation, _ = more.reset(seed=0)
    with pytest.raises(ValueError, match="Unexpected observation shape"):
        learner.predict(observation)
    learner = esc_gym.adapt(learner, more)
    assert more.action_space.contains(int(learner.predict(observation)[0]))
    learner.learn(64).save(tmp_path / "more.zip")
    again = PPO.load(tmp_path / "more.zip", env=more, device="cpu")
    actions = [each.predict(observation, deterministic=True)[0] for each in (again, learner)]
    assert actions[0] == actions[1]
