"""One cell of the paper's table: a representation that learns a target policy from samples.

Shapes: B = 512 sets a batch; d1 = 5, d2 = 10, d3 = 101.
"""

from __future__ import annotations

import warnings
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
    """One training.

    size: M of all its sets, None where it is uniform in 1..20.
    code_dim: d3, the paper's unless it is studied.
    slots: Z, the number of vehicles that FP and AP take, all unless it is studied.
    """

    benchmark: int
    size: int | None
    repr: str
    seed: int
    code_dim: int = CODE_DIM
    slots: int | None = None

    @property
    def test_sizes(self) -> tuple[int, ...]:
        """The sizes that the policy is tested on."""
        return TEST_SIZES if self.size is None else (self.size,)


class Policy(nn.Module):
    """pi(U(sets; phi); psi): the code of the vehicles and the ego, through five hidden layers.

    For FP and AP these are the paper's eleven layers with a linear one in the middle.
    """

    def __init__(self, cell: Cell) -> None:
        super().__init__()
        encoder = representation(cell.repr)
        settings: dict[str, Any] = {"max_vehicles": MAX_VEHICLES}
        if issubclass(encoder, APEncoder):
            settings = {"max_vehicles": cell.size or MAX_VEHICLES, "slots": cell.slots}
            settings |= {"low": [LOW] * VEHICLE_DIM, "high": [HIGH] * VEHICLE_DIM}
        if issubclass(encoder, FPEncoder):
            settings["sort"] = "lexicographic"
        with warnings.catch_warnings():
            # A d3 below the rule of Theorem 1 is what is studied then.
            warnings.filterwarnings("ignore", "code_dim=", UserWarning)
            self.encoder = encoder(
                vehicle_dim=VEHICLE_DIM, ego_dim=EGO_DIM, hidden=HIDDEN, code_dim=cell.code_dim,
                **settings,
            )  # fmt: skip
        self.layers = hidden_layers(cell.code_dim + EGO_DIM, HIDDEN)
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
) -> tuple[Policy, list[Point]]:
    """Train a cell: its policy, and its errors every 100 updates and at the end.

    ``tick`` hears of every update.
    """
    torch.manual_seed(cell.seed)
    policy = Policy(cell).to(device)
    learn, target = updater(policy, cell, device), TARGETS[cell.benchmark]
    tests = [(size, Samples("test", cell.seed, size).all(device)) for size in cell.test_sizes]
    points = []
    for update in range(1, updates + 1):
        learn(update)
        tick(update)
        if update % EVALUATE_EVERY == 0 or update == updates:
            errors = {size: mean_squared_error(policy, target, sets) for size, sets in tests}
            points.append(Point(update, errors))
    return policy, points


def updater(policy: Policy, cell: Cell, device: str) -> Callable[[int], None]:
    """Makes the update of a number, 1 or more: one step of Adam on 512 sets."""
    adam = torch.optim.Adam(policy.parameters(), lr=LEARNING_RATE, fused=True)
    target, samples = TARGETS[cell.benchmark], Samples("train", cell.seed, cell.size)

    def learn(update: int) -> None:
        sets = samples.draw(samples.batch(update, BATCH, device))
        loss = nn.functional.mse_loss(policy(sets), target(sets))
        adam.zero_grad()
        loss.backward()
        adam.step()

    return learn


def overtaking(device: str = "cpu") -> tuple[Tensor, Sets]:
    """The paper's example of two vehicles that change places in an order: {[j, 2], [1, 5]}.

    The other features, and the ego's, are 0. Returns the j's and as many sets.
    """
    j = torch.linspace(-3, 5, 401)
    vehicles = torch.zeros(len(j), 2, VEHICLE_DIM)
    vehicles[:, 0, 0], vehicles[:, 0, 1] = j, 2
    vehicles[:, 1, 0], vehicles[:, 1, 1] = 1, 5
    mask, ego = torch.ones(len(j), 2, dtype=torch.bool), torch.zeros(len(j), EGO_DIM)
    return j, Sets(vehicles.to(device), mask.to(device), ego.to(device))


@torch.no_grad()
def mean_squared_error(policy: Policy, target: Callable[[Sets], Tensor], sets: Sets) -> float:
    return float(nn.functional.mse_loss(policy(sets), target(sets)))
