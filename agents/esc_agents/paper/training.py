"""One cell of the paper's table: a representation that learns a target policy from samples.

Shapes: B = 512 sets a batch; d1 = 5, d2 = 10, d3 = 101.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from esc_agents.paper.samples import Samples
from esc_agents.paper.targets import (
    EGO_DIM,
    HIGH,
    LOW,
    MAX_VEHICLES,
    TARGETS,
    VEHICLE_DIM,
    Sets,
)
from esc_gym.encoders import APEncoder, FPEncoder, hidden_layers, representation

HIDDEN = (256,) * 5
CODE_DIM = 101
BATCH, LEARNING_RATE, UPDATES = 512, 8e-5, 3000
EVALUATE_EVERY = 100
TEST_SIZES = (5, 10, 15, 20)


@dataclass(frozen=True, order=True)
class Cell:
    """One training. size: M of all its sets, None where it is uniform in 1..20."""

    benchmark: int
    size: int | None
    repr: str
    seed: int

    @property
    def test_sizes(self) -> tuple[int, ...]:
        """The sizes that the policy is tested on."""
        return TEST_SIZES if self.size is None else (self.size,)


class Policy(nn.Module):
    """pi(U(sets; phi); psi): the code of the vehicles and the ego, through five hidden layers.

    For FP and AP these are the paper's eleven layers with a linear one in the middle.
    """

    def __init__(self, repr: str, size: int | None) -> None:
        super().__init__()
        encoder = representation(repr)
        settings: dict[str, Any] = (
            {"sort": "lexicographic"} if issubclass(encoder, FPEncoder) else {}
        )
        if issubclass(encoder, APEncoder):
            settings |= {"low": [LOW] * VEHICLE_DIM, "high": [HIGH] * VEHICLE_DIM}
            rows = size or MAX_VEHICLES
        else:
            rows = MAX_VEHICLES
        self.encoder = encoder(
            vehicle_dim=VEHICLE_DIM, ego_dim=EGO_DIM, max_vehicles=rows, hidden=HIDDEN,
            code_dim=CODE_DIM, **settings,
        )  # fmt: skip
        self.layers = hidden_layers(CODE_DIM + EGO_DIM, HIDDEN)
        self.output = nn.Linear(HIDDEN[-1], 1)

    def forward(self, sets: Sets) -> Tensor:
        """A number for each set [B]."""
        features = self.encoder(sets.vehicles, sets.mask, sets.ego)
        return self.output(self.layers(features)).squeeze(1)


@dataclass(frozen=True)
class Point:
    """Mean squared errors on the test samples after so many updates, by the size of the sets."""

    update: int
    errors: dict[int, float]


def train(
    cell: Cell, updates: int, device: str, tick: Callable[[int], None] = lambda update: None
) -> list[Point]:
    """Train a cell; its errors every 100 updates and at the end. ``tick`` hears of every update."""
    torch.manual_seed(cell.seed)
    policy = Policy(cell.repr, cell.size).to(device)
    fused = torch.optim.Adam(policy.parameters(), lr=LEARNING_RATE, fused=True)
    target, samples = TARGETS[cell.benchmark], Samples("train", cell.seed, cell.size)
    tests = [(size, Samples("test", cell.seed, size).all(device)) for size in cell.test_sizes]
    points = []
    for update in range(1, updates + 1):
        sets = samples.draw(samples.batch(update, BATCH, device))
        loss = nn.functional.mse_loss(policy(sets), target(sets))
        fused.zero_grad()
        loss.backward()
        fused.step()
        tick(update)
        if update % EVALUATE_EVERY == 0 or update == updates:
            errors = {size: mean_squared_error(policy, target, sets) for size, sets in tests}
            points.append(Point(update, errors))
    return points


@torch.no_grad()
def mean_squared_error(policy: Policy, target: Callable[[Sets], Tensor], sets: Sets) -> float:
    return float(nn.functional.mse_loss(policy(sets), target(sets)))
