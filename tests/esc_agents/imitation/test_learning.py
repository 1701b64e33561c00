"""Losses beside NumPy's own arithmetic, and a policy that has to learn a known rule."""

import numpy as np
import pytest
import torch

from esc_agents.driving.batch import BatchVecEnv
from esc_agents.errors import UserError
from esc_agents.imitation.labels import Labels
from esc_agents.imitation.learning import LOSSES, fit, measure, unit_of
from esc_agents.training.models import new_model
from tests.esc_agents.imitation.small import small

GENERATOR = np.random.default_rng(0)
SCORES, TARGETS = GENERATOR.normal(size=(2, 7, 5))


def softmax(x):
    return np.exp(x) / np.exp(x).sum(axis=1, keepdims=True)


def centred(x):
    return x - x.mean(axis=1, keepdims=True)


EXPECTED = {
    "values": np.mean((centred(SCORES) - centred(TARGETS)) ** 2),
    "cross-entropy": -np.mean(np.sum(softmax(TARGETS) * np.log(softmax(SCORES)), axis=1)),
    "regret": np.mean(
        np.sum(softmax(SCORES) * (TARGETS.max(axis=1, keepdims=True) - TARGETS), axis=1)
    ),
}


@pytest.mark.parametrize("name", LOSSES)
def test_losses(name):
    found = LOSSES[name](torch.tensor(SCORES), torch.tensor(TARGETS))
    assert float(found) == pytest.approx(EXPECTED[name])


@pytest.mark.parametrize("name", ["values", "cross-entropy"])
def test_no_policy_is_better_than_the_softmax_of_the_values(name):
    scores = torch.tensor(TARGETS + 3.0, requires_grad=True)
    LOSSES[name](scores, torch.tensor(TARGETS)).backward()
    assert float(scores.grad.abs().max()) < 1e-12


@pytest.fixture
def policy():
    config = small().train_config()
    return new_model(config, BatchVecEnv(config, config.n_envs)).policy


def rule(policy, count):
    """Labels: the best action is 4 where the first vehicle is ahead, else 0; all others are worth
    half of that, and equally much."""
    generator = np.random.default_rng(1)
    spaces = policy.observation_space
    seen = {
        name: np.stack([space.sample() for _ in range(count)]) for name, space in spaces.items()
    }
    seen["mask"][:] = 0
    seen["mask"][:, 0] = 1
    ahead = generator.random(count) < 0.3
    seen["vehicles"][:] = 0
    seen["vehicles"][:, 0, 0] = np.where(ahead, 1.0, -1.0)
    values = np.full((count, 5), 0.5, np.float32)
    values[np.arange(count), np.where(ahead, 4, 0)] = 1.0
    return Labels({name: part.astype(np.float32) for name, part in seen.items()}, values)


@pytest.mark.parametrize("loss", LOSSES)
def test_a_rule_is_learned(policy, loss):
    labels = rule(policy, 400)
    before, blind = measure(policy, labels), 0.5 * 0.3
    config = small(loss=loss, epochs=30, learning_rate=1e-2)
    fit(policy, labels, config, 0)
    after = measure(policy, rule(policy, 300))
    assert before.regret > 0.1
    assert (after.regret, after.agreement) == (0.0, 1.0)
    assert after.blind_regret == pytest.approx(blind, abs=0.03)


def test_the_unit_is_of_differences_only():
    labels = Labels({}, np.array([[1, 3], [100, 100], [7, 5]], np.float32))
    assert unit_of(labels) == pytest.approx(np.sqrt(4 / 6))
    assert unit_of(Labels({}, np.ones((3, 2), np.float32))) == 1.0


def test_what_diverges_is_said(policy):
    labels = rule(policy, 64)
    with pytest.raises(UserError, match="the loss is not finite; a smaller --learning-rate"):
        fit(policy, labels, small(learning_rate=1e30, epochs=3), 0)


def test_stopped_before_a_pass(policy):
    labels = rule(policy, 64)
    calls = iter([False, True])
    before = {name: tensor.clone() for name, tensor in policy.state_dict().items()}
    fit(policy, labels, small(epochs=5), 0, lambda: next(calls))
    assert any(not torch.equal(before[name], t) for name, t in policy.state_dict().items())
    assert next(calls, None) is None
