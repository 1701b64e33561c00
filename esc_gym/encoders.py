"""Encoders of a traffic set as plain torch modules: ``{ego, vehicles, mask}`` -> features.

Shapes: B = batch, N = rows of the padded set, M = real rows of one set, d1 = vehicle features,
d2 = ego features, d3 = ``code_dim``. Rows with mask 0 are padding: whatever they hold, even NaN,
reaches neither outputs nor gradients. M = 0 is legal everywhere.
"""

from __future__ import annotations

import difflib
import math
import warnings
from collections.abc import Sequence
from importlib import import_module
from numbers import Integral
from operator import lt
from typing import Any, Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn import functional

from esc_gym.sets import (
    all_real,
    is_all_real,
    leading,
    ordering,
    pack,
    segment_max,
    segment_sum,
    take,
)

Sort = Literal["distance", "lexicographic"]
DEFAULT_HIDDEN = (128, 128)


class SetEncoder(nn.Module):
    """Base: features = concat(set code [B, d3], ego [B, d2]). Subclasses write ``encode``.

    vehicle_dim, ego_dim, max_vehicles: d1, d2 and N.
    hidden: widths of the hidden layers, at least one.
    code_dim: d3, by default N*d1 + 1, the rule of the paper's Theorem 1.
    scale: multiplies the code. Injectivity doesn't depend on it; for a sum over many vehicles 1/10,
        say, keeps the inputs of the policy moderate.
    """

    permutation_invariant: bool = True
    any_size: bool = True  # whether forward takes any N, the weights not depending on it

    def __init__(
        self,
        *,
        vehicle_dim: int,
        ego_dim: int,
        max_vehicles: int,
        hidden: Sequence[int] = DEFAULT_HIDDEN,
        code_dim: int | None = None,
        scale: float = 1.0,
    ) -> None:
        super().__init__()
        self.hidden = tuple(hidden)
        if not self.hidden:
            raise ValueError("hidden: expected at least one width, got none")
        widths = {f"hidden[{i}]": width for i, width in enumerate(self.hidden)}
        _check_positive(
            vehicle_dim=vehicle_dim, ego_dim=ego_dim, max_vehicles=max_vehicles, **widths
        )
        self.vehicle_dim, self.ego_dim, self.max_vehicles = vehicle_dim, ego_dim, max_vehicles
        self.required_code_dim = max_vehicles * vehicle_dim + 1
        self.code_dim = self.required_code_dim if code_dim is None else code_dim
        _check_positive(code_dim=self.code_dim)
        if not math.isfinite(scale) or scale == 0:
            raise ValueError(f"scale: expected a finite number other than 0, got {scale!r}")
        self.scale = scale
        self.features_dim = self.code_dim + ego_dim

    def forward(self, vehicles: Tensor, mask: Tensor | None, ego: Tensor) -> Tensor:
        """vehicles [B, N, d1], mask [B, N] (nonzero = real), ego [B, d2] -> [B, d3 + d2].

        Without padding the mask can be None: then no shape depends on values, and torch.func.vmap
        and CUDA graphs can be used.
        """
        self._check(vehicles, mask, ego)
        real = all_real(vehicles) if mask is None else mask != 0
        return torch.cat([self.scale * self.encode(vehicles, real, ego), ego], dim=1)

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        """The set code [B, d3], not yet scaled; mask is bool. Padding may hold anything."""
        raise NotImplementedError(f"{type(self).__name__} has to define encode()")

    def _check(self, vehicles: Tensor, mask: Tensor | None, ego: Tensor) -> None:
        like, dims = (vehicles, 3) if mask is None else (mask, 2)
        batch, rows = tuple(like.shape[:2]) if like.dim() == dims else ("B", "N")
        expected = {
            "vehicles": (vehicles, (batch, rows, self.vehicle_dim)),
            "mask": (like[..., 0] if mask is None else mask, (batch, rows)),
            "ego": (ego, (batch, self.ego_dim)),
        }
        for name, (tensor, shape) in expected.items():
            if tuple(tensor.shape) != shape:
                text = str(shape).replace("'", "")
                raise ValueError(f"{name}: expected shape {text}, got {tuple(tensor.shape)}")
        dtype = next(self.parameters(), vehicles).dtype
        for name, tensor in (("vehicles", vehicles), ("ego", ego)):
            if tensor.dtype != dtype:
                raise ValueError(
                    f"{name}: expected dtype {dtype}, that of the weights, got {tensor.dtype}; "
                    "convert the tensor or the encoder with .to(dtype)"
                )


def _check_positive(**values: Any) -> None:
    for name, value in values.items():
        if not isinstance(value, Integral) or isinstance(value, bool) or value < 1:
            raise ValueError(f"{name}: expected an integer >= 1, got {value!r}")


def hidden_layers(inputs: int, hidden: Sequence[int]) -> nn.Sequential:
    """Fully connected layers of these widths, each followed by GELU."""
    layers = nn.Sequential()
    for width in hidden:
        layers.extend([nn.Linear(inputs, width), nn.GELU()])
        inputs = width
    return layers


class _PooledEncoder(SetEncoder):
    """A feature network h, applied to each vehicle: hidden layers with GELU, linear output."""

    def __init__(self, **dims: Any) -> None:
        super().__init__(**dims)
        self.layers = hidden_layers(self.vehicle_dim, self.hidden)
        self.output = nn.Linear(self.hidden[-1], self.code_dim)

    def _sum(self, vehicles: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
        """sum_i mask_i h(x_i) [B, d3], and M as floats [B, 1]."""
        if is_all_real(mask):
            activations = self.layers(vehicles).sum(dim=1)
        else:
            rows, owner = pack(vehicles, mask)
            activations = segment_sum(self.layers(rows), owner, len(mask))
        count = mask.sum(dim=1, keepdim=True).to(vehicles.dtype)
        # The linear output layer commutes with the sum: sum_i (W a_i + b) = W sum_i a_i + M b.
        return functional.linear(activations, self.output.weight) + count * self.output.bias, count


class ESCEncoder(_PooledEncoder):
    """Encoding sum and concatenation, the paper's equation for U_ESC: sum_i h(x_i).

    Of the d3 numbers of a code at most hidden[-1] + 1 are independent, as h ends in a linear layer
    and the sum knows M besides: only with hidden[-1] >= d3 - 1 is it as wide as Theorem 1 asks.
    """

    def __init__(self, **dims: Any) -> None:
        super().__init__(**dims)
        if self.code_dim < self.required_code_dim:
            warnings.warn(
                f"code_dim={self.code_dim} is less than N*d1 + 1 = {self.required_code_dim}, from "
                "which on Theorem 1 says that different sets can have different codes",
                stacklevel=2,
            )

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        return self._sum(vehicles, mask)[0]


class MeanEncoder(_PooledEncoder):
    """Mean of h over the vehicles, 0 for none. It can't tell a set from the same set twice."""

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        total, count = self._sum(vehicles, mask)
        return total / count.clamp(min=1)


class MaxEncoder(_PooledEncoder):
    """Element-wise maximum of h over the vehicles, 0 for none."""

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        rows, owner = pack(vehicles, mask)
        return segment_max(self.output(self.layers(rows)), owner, len(mask))


class AttentionEncoder(SetEncoder):
    """Ego attention: the ego asks, the vehicles answer; 0 for none. Blind to duplicates of a set.

    heads: attention heads, each of width ceil(hidden[-1] / heads).
    """

    def __init__(self, *, heads: int = 2, **dims: Any) -> None:
        super().__init__(**dims)
        _check_positive(heads=heads)
        self.heads, self.width = heads, -(-self.hidden[-1] // heads)
        total = heads * self.width
        self.layers = hidden_layers(self.vehicle_dim, self.hidden)
        self.key_value = nn.Linear(self.hidden[-1], 2 * total)
        self.query = nn.Linear(self.ego_dim, total)
        self.output = nn.Linear(total, self.code_dim)

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        rows, owner = pack(vehicles, mask)
        answers = self.key_value(self.layers(rows)).view(-1, 2, self.heads, self.width)
        key, value = answers.unbind(dim=1)  # [sum M, heads, width] each
        query = self.query(ego).view(-1, self.heads, self.width)
        score = (query[owner] * key).sum(dim=2) / math.sqrt(self.width)
        # Softmax within each set; subtracting its largest score changes no weight, only overflow.
        weight = (score - segment_max(score.detach(), owner, len(mask))[owner]).exp()
        weight = weight / segment_sum(weight, owner, len(mask))[owner]
        answer = segment_sum(weight[:, :, None] * value, owner, len(mask))
        return self.output(answer.flatten(1)) * mask.any(dim=1, keepdim=True)


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
        _check_positive(slots=self.slots)
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


REPRESENTATIONS: dict[str, type[SetEncoder]] = {
    "esc": ESCEncoder,
    "fp": FPEncoder,
    "ap": APEncoder,
    "mean": MeanEncoder,
    "max": MaxEncoder,
    "attention": AttentionEncoder,
}


def representation(name: str) -> type[SetEncoder]:
    """The encoder class of a name in ``REPRESENTATIONS``, or of a path "module:Class"."""
    if name in REPRESENTATIONS:
        return REPRESENTATIONS[name]
    known = f"expected one of {', '.join(REPRESENTATIONS)}, or a path 'module:Class'"
    module, colon, attribute = name.partition(":")
    if not colon:
        near = difflib.get_close_matches(name, REPRESENTATIONS, n=1)
        hint = f"; did you mean {near[0]!r}?" if near else ""
        raise ValueError(f"unknown representation {name!r}: {known}{hint}")
    try:
        encoder = getattr(import_module(module), attribute)
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(f"representation {name!r}: {error}; {known}") from error
    if not (isinstance(encoder, type) and issubclass(encoder, SetEncoder)):
        raise ValueError(f"representation {name!r}: expected a subclass of SetEncoder")
    return encoder
