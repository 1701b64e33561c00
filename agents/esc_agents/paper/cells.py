"""One cell of the paper's table: a representation that learns a target policy from samples.

Shapes: B = 512 sets a batch; d1 = 5, d2 = 10, d3 = 101.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.func import functional_call, vmap

from esc_agents.paper.samples import Samples
from esc_agents.paper.targets import EGO_DIM, HIGH, LOW, MAX_VEHICLES, TARGETS, VEHICLE_DIM, Sets
from esc_gym.encoders import APEncoder, FPEncoder, hidden_layers, representation

HIDDEN = (256,) * 5
CODE_DIM = 101
Init = Literal["glorot", "torch"]
INIT: Init = "glorot"
BATCH, LEARNING_RATE, UPDATES = 512, 8e-5, 3000
WARM_UP = 3  # calls before a CUDA graph is captured, as torch advises
EVALUATE_EVERY = 100
TEST_SIZES = (5, 10, 15, 20)


@dataclass(frozen=True, order=True)
class Cell:
    """One training.

    size: M of all its sets, None where it is uniform in 1..20.
    code_dim: d3, the paper's unless it is studied.
    slots: Z, the number of vehicles that FP and AP take, all unless it is studied.
    init: how weights start, which the paper does not say. "glorot": uniform in Glorot's bounds and
        biases 0, as in its first author's code of that time (DSAC, 2020). "torch": as torch starts
        linear layers, with weights smaller by a factor of sqrt(3) where a layer is square.
    """

    benchmark: int
    size: int | None
    repr: str
    seed: int
    code_dim: int = CODE_DIM
    slots: int | None = None
    init: Init = INIT

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
        if cell.init == "glorot":
            for layer in self.modules():
                if isinstance(layer, nn.Linear):
                    nn.init.xavier_uniform_(layer.weight)
                    nn.init.zeros_(layer.bias)

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
    cells: Sequence[Cell], updates: int, device: str,
    tick: Callable[[int], None] = lambda update: None,
) -> list[tuple[Policy, list[Point]]]:  # fmt: skip
    """Train cells that differ only in their seeds, of one size as one batched model.

    Returns the policy of each, and its errors every 100 updates and at the end. ``tick`` hears of
    every update.
    """
    policies = []
    for cell in cells:
        torch.manual_seed(cell.seed)
        policies.append(Policy(cell).to(device))
    learn = updater(policies, cells, device)
    tests = [
        [(size, Samples("test", cell.seed, size).all(device)) for size in cell.test_sizes]
        for cell in cells
    ]
    points: list[list[Point]] = [[] for _ in cells]
    for update in range(1, updates + 1):
        learn(update)
        tick(update)
        if update % EVALUATE_EVERY == 0 or update == updates:
            for cell, policy, sized, found in zip(cells, policies, tests, points, strict=True):
                errors = {size: error(policy, cell, sets) for size, sets in sized}
                found.append(Point(update, errors))
    return list(zip(policies, points, strict=True))


def updater(
    policies: Sequence[Policy], cells: Sequence[Cell], device: str
) -> Callable[[int], None]:
    """Makes the update of a number, 1 or more: a step of Adam for each policy, on 512 sets.

    On a GPU it is launched as one graph, unless M varies and with it the shapes.
    """
    one_size, on_gpu = cells[0].size is not None, device.startswith("cuda")
    if len(cells) > 1 and one_size:
        losses, parameters = _batched(policies, cells, device)
    else:
        losses, parameters = _one_by_one(policies, cells, device)
    adam = torch.optim.Adam(parameters, lr=LEARNING_RATE, fused=True, capturable=on_gpu)

    def learn(update: int | Tensor) -> None:
        total = losses(update).sum()  # of which each policy's gradient is that of its own loss
        adam.zero_grad()
        total.backward()
        adam.step()

    return _captured(learn, device) if on_gpu and one_size else learn


def _captured(learn: Callable[[Tensor], None], device: str) -> Callable[[int], None]:
    """The same as one launch, of a CUDA graph that is captured after the first calls."""
    number = torch.zeros((), dtype=torch.int64, device=device)
    graph, beside, calls = torch.cuda.CUDAGraph(), torch.cuda.Stream(device), 0

    def launch(update: int) -> None:
        nonlocal calls
        calls += 1
        number.fill_(update)
        if calls <= WARM_UP:  # on another stream, so that the graph finds nothing half done
            beside.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(beside):
                learn(number)
            torch.cuda.current_stream().wait_stream(beside)
            return
        if calls == WARM_UP + 1:
            with torch.cuda.graph(graph):
                learn(number)  # recorded, not run
        graph.replay()

    return launch


def _one_by_one(
    policies: Sequence[Policy], cells: Sequence[Cell], device: str
) -> tuple[Callable[[int | Tensor], Tensor], list[Tensor]]:
    """(losses [S] of an update, what to train)."""
    each = [Samples("train", cell.seed, cell.size) for cell in cells]

    def losses(update: int | Tensor) -> Tensor:
        batches = [samples.draw(samples.batch(update, BATCH, device)) for samples in each]
        found = [loss(p, cells[0], sets) for p, sets in zip(policies, batches, strict=True)]
        return torch.stack(found)

    return losses, [parameter for policy in policies for parameter in policy.parameters()]


def _batched(
    policies: Sequence[Policy], cells: Sequence[Cell], device: str
) -> tuple[Callable[[int | Tensor], Tensor], list[Tensor]]:
    """(losses [S] of an update, what to train), with one product for the layer of all policies.

    The policies' own parameters become views of what is trained.
    """
    stacked = {
        name: torch.stack(list(same)).detach().requires_grad_()
        for name, same in _by_name(policies).items()
    }
    for number, policy in enumerate(policies):
        for name, parameter in policy.named_parameters():
            parameter.data = stacked[name].data[number]
    samples = Samples("train", tuple(cell.seed for cell in cells), cells[0].size)
    policy = policies[0]

    def one(parameters: dict[str, Tensor], vehicles: Tensor, ego: Tensor) -> Tensor:
        sets = Sets(vehicles, None, ego)
        return loss(lambda sets: functional_call(policy, parameters, (sets,)), cells[0], sets)

    def losses(update: int | Tensor) -> Tensor:
        sets = samples.draw(samples.batch(update, BATCH, device))
        return vmap(one)(stacked, sets.vehicles, sets.ego)

    return losses, list(stacked.values())


def _by_name(policies: Sequence[Policy]) -> dict[str, list[Tensor]]:
    named = [dict(policy.named_parameters()) for policy in policies]
    return {name: [parameters[name] for parameters in named] for name in named[0]}


def loss(policy: Callable[[Sets], Tensor], cell: Cell, sets: Sets) -> Tensor:
    """Mean squared error of a policy."""
    return nn.functional.mse_loss(policy(sets), TARGETS[cell.benchmark](sets))


@torch.no_grad()
def error(policy: Policy, cell: Cell, sets: Sets) -> float:
    """The same, as a number."""
    return loss(policy, cell, sets).item()


def overtaking(device: str = "cpu") -> tuple[Tensor, Sets]:
    """The paper's example of two vehicles that change places in an order: {[j, 2], [1, 5]}.

    The other features, and the ego's, are 0. Returns the j's and as many sets.
    """
    j = torch.linspace(-3, 5, 401)
    vehicles = torch.zeros(len(j), 2, VEHICLE_DIM)
    vehicles[:, 0, 0], vehicles[:, 0, 1] = j, 2
    vehicles[:, 1, 0], vehicles[:, 1, 1] = 1, 5
    return j, Sets(vehicles.to(device), None, torch.zeros(len(j), EGO_DIM, device=device))
