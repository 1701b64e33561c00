"""The six policies that the networks have to learn, from the paper's table of benchmarks.

Shapes: B sets of at most N vehicles, d1 = 5, d2 = 10. A target is a number for each set [B].
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from math import inf
from operator import mul
from typing import NamedTuple

from torch import Tensor

VEHICLE_DIM, EGO_DIM, MAX_VEHICLES = 5, 10, 20
LOW, HIGH = -5.0, 5.0


class Sets(NamedTuple):
    """A batch: vehicles [B, N, 5], mask [B, N] bool, ego [B, 10].

    The mask is true for the M >= 1 real rows, None where all of them are.
    """

    vehicles: Tensor
    mask: Tensor | None
    ego: Tensor

    def real(self, values: Tensor, padding: float) -> Tensor:
        """values [B, N], and ``padding`` in the rows that are none."""
        return values if self.mask is None else values.masked_fill(~self.mask, padding)

    def smallest(self, values: Tensor) -> Tensor:
        """Minimum over the vehicles of values [B, N]."""
        return self.real(values, inf).amin(dim=1)

    def largest(self, values: Tensor) -> Tensor:
        """Maximum over the vehicles of values [B, N]."""
        return self.real(values, -inf).amax(dim=1)

    def mean(self, values: Tensor) -> Tensor:
        """Mean over the vehicles of values [B, N]."""
        count = values.shape[1] if self.mask is None else self.mask.sum(dim=1)
        return self.real(values, 0).sum(dim=1) / count


def norm(x: Tensor, p: int) -> Tensor:
    """p-norm over the last dimension."""
    # Not torch.linalg.vector_norm: on a CPU that takes ten times as long over five elements.
    return reduce(mul, [x.abs()] * p).sum(dim=-1).pow(1 / p)


def _target_1(s: Sets) -> Tensor:
    x = s.vehicles
    spread = s.mean(norm(x, 1)) * s.largest(norm(x, 2))
    return s.ego.mean(dim=1) - 0.2 * s.smallest(norm(x, 3)) + 0.4 * spread


def _target_2(s: Sets) -> Tensor:
    x = s.vehicles
    return 0.5 * s.ego.amin(dim=1) * s.largest(x.amax(dim=2)) * s.smallest(norm(x, 4))


def _target_3(s: Sets) -> Tensor:
    x = s.vehicles
    return 0.2 * norm(s.ego, 3) + 2 * s.mean(norm(x, 1)) * s.mean(x.amax(dim=2))


def _target_4(s: Sets) -> Tensor:
    x = s.vehicles
    ratios = x.amin(dim=2) / (norm(x, 2) + 0.1)
    return 5 * norm(s.ego, 2) * norm(s.real(ratios, 0), 4)


def _target_5(s: Sets) -> Tensor:
    x = s.vehicles
    return 10 * norm(s.ego, 4) * s.mean(x.mean(dim=2) * x.amax(dim=2) / (norm(x, 4) + 0.1))


def _target_6(s: Sets) -> Tensor:
    x = s.vehicles
    return 8 * norm(s.ego, 2) * s.largest(x.mean(dim=2) * norm(x, 3) / (norm(x, 2) + 0.1))


TARGETS: dict[int, Callable[[Sets], Tensor]] = {
    1: _target_1,
    2: _target_2,
    3: _target_3,
    4: _target_4,
    5: _target_5,
    6: _target_6,
}
"""The paper's benchmarks by number."""
