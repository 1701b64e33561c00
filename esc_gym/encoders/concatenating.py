"""Encoders that lay the vehicles side by side: all permutations (AP), fixed permutation (FP)."""

from __future__ import annotations

from collections.abc import Sequence
from operator import lt
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from esc_gym.encoders.base import SetEncoder, check_positive, hidden_layers
from esc_gym.sets import is_all_real, leading, ordering, take

Sort = Literal["distance", "lexicographic"]


class APEncoder(SetEncoder):
    """All permutations: the rows in the order given, concatenated, through one network.

    The paper trains it on every order: give it observations with ``order="shuffled"``.

    slots: Z, rows that the network takes: the first Z real ones, the rest filled with a virtual
        vehicle straight ahead at the perception distance. By default N, and then another N is
        refused; with Z given any N will do.
    position: columns of x and y. low, high: bounds of each column in the observation space (by
        default -high and 1); in x and y they are the perception distance, in scaled units.
    """

    permutation_invariant = False
    center: Tensor  # [2], position of the ego, scaled
    reach: Tensor  # [2], perception distance, scaled
    virtual: Tensor  # [d1]

    def __init__(
        self,
        *,
        slots: int | None = None,
        position: tuple[int, int] = (0, 1),
        low: Sequence[float] | None = None,
        high: Sequence[float] | None = None,
        **dims: Any,
    ) -> None:
        super().__init__(**dims)
        self.any_size = slots is not None
        self.slots = self.max_vehicles if slots is None else slots
        check_positive(slots=self.slots)
        self.position = list(position)
        columns = range(self.vehicle_dim)
        if len(self.position) != 2 or not set(self.position) <= set(columns):
            raise ValueError(f"position: expected two of {len(columns)} columns, got {position}")
        upper = [1.0] * len(columns) if high is None else [float(value) for value in high]
        lower = [-value for value in upper] if low is None else [float(value) for value in low]
        if not len(lower) == len(upper) == len(columns) or not all(map(lt, lower, upper)):
            raise ValueError(
                f"low, high: expected low < high in {len(columns)} columns, got {lower}, {upper}"
            )
        center = torch.tensor([(lower[column] + upper[column]) / 2 for column in position])
        ahead = torch.tensor([upper[column] for column in position])
        virtual = torch.zeros(len(columns))
        virtual[self.position] = torch.stack([ahead[0], center[1]])
        # Not persistent: they follow from the arguments; a state dict holds what is learned.
        self.register_buffer("center", center, persistent=False)
        self.register_buffer("reach", ahead - center, persistent=False)
        self.register_buffer("virtual", virtual, persistent=False)
        self.layers = hidden_layers(self.slots * self.vehicle_dim, self.hidden)
        self.output = nn.Linear(self.hidden[-1], self.code_dim)

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        rows = mask.shape[1]
        if rows != self.max_vehicles and not self.any_size:
            raise ValueError(
                f"{type(self).__name__}: expected {self.max_vehicles} rows, as built, got {rows}; "
                "pass slots=Z to take Z rows of any number, or use a pooling encoder such as esc"
            )
        table = self.arrange(vehicles, mask)[:, : self.slots]
        table = functional.pad(table, (0, 0, 0, self.slots - table.shape[1]))
        table = torch.where(leading(mask, self.slots)[:, :, None], table, self.virtual)
        return self.output(self.layers(table.flatten(1)))

    def arrange(self, vehicles: Tensor, mask: Tensor) -> Tensor:
        """The real rows in the order in which they take the slots, then padding: [B, k, d1]."""
        if is_all_real(mask):
            return vehicles
        return take(vehicles, ordering(torch.zeros_like(vehicles[:, :, 0]), mask))


class FPEncoder(APEncoder):
    """Fixed permutation: the Z nearest rows in a declared order, concatenated, as in ``APEncoder``.

    sort: "distance" to the ego in metres, whatever the scale of the columns, or "lexicographic",
        by the first column, then the second, and so on, as in the paper.

    The order given doesn't matter, unless distances tie exactly (then it decides). The code jumps
    where two vehicles change places in the order: the discontinuity that the paper criticises.
    """

    permutation_invariant = True

    def __init__(self, *, sort: Sort = "distance", **settings: Any) -> None:
        super().__init__(**settings)
        if sort not in get_args(Sort):
            raise ValueError(f"sort: expected one of {', '.join(get_args(Sort))}, got {sort!r}")
        self.sort = sort

    def arrange(self, vehicles: Tensor, mask: Tensor) -> Tensor:
        offset = (vehicles[:, :, self.position] - self.center) / self.reach
        order = ordering(offset.square().sum(dim=2), mask)[:, : self.slots]
        if self.sort == "lexicographic":
            real = leading(mask, order.shape[1])
            for column in reversed(range(self.vehicle_dim)):
                key = vehicles[:, :, column].gather(1, order)
                order = order.gather(1, ordering(key, real))
        return take(vehicles, order)
