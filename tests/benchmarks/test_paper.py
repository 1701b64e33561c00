"""An update of esc-paper against nothing but the matrix products of its layers, on one core.

The products: of each layer the output, the gradient of the weights and, but for the first layer,
the gradient of the input; over all vehicles for ESC's h, over the 512 sets for the rest.
"""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import nn

from esc_agents.paper.cells import BATCH, Cell, Policy, updater
from esc_agents.paper.samples import Samples
from tests.benchmarks.interleaved import fastest, torch_threads

CELLS = [Cell(1, 20, "esc", 0), Cell(1, None, "esc", 0), Cell(1, 5, "fp", 0), Cell(1, 20, "ap", 0)]


@pytest.fixture(autouse=True)
def _one_thread() -> Iterator[None]:
    with torch_threads(1):
        yield


def products(policy: Policy, cell: Cell, update: int) -> Callable[[], None]:
    """The bare matrix products of an update."""
    samples = Samples("train", 0, cell.size)
    mask = samples.draw(samples.batch(update, BATCH)).mask
    vehicles = BATCH * (cell.size or 0) if mask is None else int(mask.sum())
    operands = []
    for name, layer in policy.named_modules():
        if isinstance(layer, nn.Linear):
            per_vehicle = cell.repr == "esc" and "encoder.layers" in name
            rows = vehicles if per_vehicle else BATCH
            x, grad = torch.randn(rows, layer.in_features), torch.randn(rows, layer.out_features)
            operands.append((x, layer.weight.detach(), grad))

    def run() -> None:
        for number, (x, weight, grad) in enumerate(operands):
            torch.mm(x, weight.t())
            torch.mm(grad.t(), x)
            if number:
                torch.mm(grad, weight)

    return run


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: f"{cell.repr}-{cell.size or 'any'}")
def test_an_update_costs_what_its_matrix_products_cost(benchmark: Any, cell: Cell) -> None:
    policy = Policy(cell)
    learn = updater([policy], [cell], "cpu")
    runs = {"update": lambda: learn(1), "products": products(policy, cell, 1)}
    best = fastest(runs)
    benchmark.pedantic(runs["update"], rounds=3)
    benchmark.extra_info |= {"update / products": best["update"] / best["products"]}
    print({name: round(ratio, 2) for name, ratio in benchmark.extra_info.items()})  # noqa: T201
    assert best["update"] <= 1.3 * best["products"]
