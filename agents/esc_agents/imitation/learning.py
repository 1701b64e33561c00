"""Supervised training of a policy on what an expert says that actions are worth.

A policy that is learned from values v is softmax(v / temperature), with v in units of how much they
differ between the actions of one state. The losses differ in how they come near to it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import log_softmax

from esc_agents.errors import UserError
from esc_agents.imitation.labels import Labels
from esc_agents.imitation.settings import ImitateConfig, Loss

CHUNK = 4096  # states at once, where nothing is learned


@dataclass(frozen=True)
class Measured:
    """How far a policy is from its expert on some labels.

    regret: mean of the best value minus that of the action chosen. agreement: share of the states
    in which the action chosen is worth as much as the best. blind_regret: of the one action that is
    best on average.
    """

    regret: float
    agreement: float
    blind_regret: float


def logits(policy: Any, observations: dict[str, Tensor]) -> Tensor:
    """[K, A], of an SB3 ``ActorCriticPolicy`` with discrete actions."""
    latent = policy.mlp_extractor.forward_actor(policy.extract_features(observations))
    return policy.action_net(latent)


def by_values(scores: Tensor, targets: Tensor) -> Tensor:
    """Squared error beside the targets, both without what they have in common."""
    return ((_centred(scores) - _centred(targets)) ** 2).mean()


def by_cross_entropy(scores: Tensor, targets: Tensor) -> Tensor:
    """Beside softmax(targets): ties share, and what is nearly as good counts."""
    return -(targets.softmax(dim=1) * log_softmax(scores, dim=1)).sum(dim=1).mean()


def by_regret(scores: Tensor, targets: Tensor) -> Tensor:
    """What the policy loses on average beside the best action."""
    lost = targets.max(dim=1, keepdim=True).values - targets
    return (scores.softmax(dim=1) * lost).sum(dim=1).mean()


LOSSES: dict[Loss, Callable[[Tensor, Tensor], Tensor]] = {
    "values": by_values, "cross-entropy": by_cross_entropy, "regret": by_regret,
}  # fmt: skip


def _centred(values: Tensor) -> Tensor:
    return values - values.mean(dim=1, keepdim=True)


def unit_of(labels: Labels) -> float:
    """How much values differ between the actions of one state: the root mean square."""
    spread = labels.values - labels.values.mean(axis=1, keepdims=True)
    return float(np.sqrt(np.mean(spread.astype(np.float64) ** 2))) or 1.0


def fit(
    policy: Any, labels: Labels, config: ImitateConfig, seed: int,
    stop: Callable[[], bool] = lambda: False,
) -> float:  # fmt: skip
    """Train ``policy`` in place; the mean loss of the last pass.

    seed: of the order of the labels. stop: asked before each pass, of which none follows once true.
    Raises UserError where weights become infinite.
    """
    seen, values = _tensors(labels, policy.device)
    targets = values / (unit_of(labels) * config.temperature)
    loss_of = LOSSES[config.loss]
    batches = -(-len(labels) // config.batch_size)
    optimizer = torch.optim.Adam(policy.parameters(), config.learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, config.epochs * batches)
    generator = torch.Generator().manual_seed(seed)
    policy.set_training_mode(True)
    total = 0.0
    for _ in range(config.epochs):
        if stop():
            break
        total = 0.0
        order = torch.randperm(len(labels), generator=generator).to(policy.device)
        for chosen in order.split(config.batch_size):
            batch = {name: part[chosen] for name, part in seen.items()}
            loss = loss_of(logits(policy, batch), targets[chosen])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
            total += float(loss.detach()) * len(chosen)
    policy.set_training_mode(False)
    if not np.isfinite(total):
        raise UserError("imitation: the loss is not finite; a smaller --learning-rate may help")
    return total / len(labels)


@torch.no_grad()
def measure(policy: Any, labels: Labels) -> Measured:
    """How far the deterministic policy is from its expert."""
    seen, values = _tensors(labels, policy.device)
    chosen = torch.cat([
        logits(policy, {name: part[i : i + CHUNK] for name, part in seen.items()}).argmax(dim=1)
        for i in range(0, len(labels), CHUNK)
    ])  # fmt: skip
    lost = values.max(dim=1, keepdim=True).values - values
    regret = lost.gather(1, chosen[:, None])
    return Measured(
        float(regret.mean()), float((regret == 0).float().mean()), float(lost.mean(dim=0).min())
    )


def _tensors(labels: Labels, device: torch.device) -> tuple[dict[str, Tensor], Tensor]:
    seen = {name: torch.as_tensor(part).to(device) for name, part in labels.observations.items()}
    return seen, torch.as_tensor(labels.values).to(device)
