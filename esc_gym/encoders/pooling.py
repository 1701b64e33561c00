"""Encoders that pool h(x_i) over the vehicles, whose order cannot matter, nor their number N."""

from __future__ import annotations

import math
import warnings
from typing import Any

from torch import Tensor, nn
from torch.nn import functional

from esc_gym.encoders.base import SetEncoder, check_positive, hidden_layers, is_number
from esc_gym.sets import is_all_real, pack, segment_max, segment_sum


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

    Of the d3 numbers of a code at most hidden[-1] + 1 are linearly independent, as h ends in a
    linear layer and the sum knows M besides: only with hidden[-1] >= d3 - 1 is it as wide as
    Theorem 1 asks.
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


class ESCExpEncoder(ESCEncoder):
    """ESC with h(x) = exp(sharpness * g(x)), g the network: a sum in which the nearest can win.

    The code is log(1 + sum_i h(x_i)) / sharpness, which says neither more nor less than the sum. g
    is held within -80 / sharpness and 80 / sharpness, lest exponentials, or the sum of 5,000 of
    them, be too large for float32. With that g the code is a maximum, max(0, max_i g(x_i)), and at
    most log(1 + M) / sharpness more; of those at the upper limit it tells the number. As the
    exponential comes before the sum, all d3 numbers are linearly independent, however narrow
    ``hidden``.

    sharpness: 0.001 to 1e6; the greater, the closer to the maximum, and the lower the limit.
    """

    LIMIT = 80.0

    def __init__(self, *, sharpness: float = 100.0, **dims: Any) -> None:
        super().__init__(**dims)
        if not is_number(sharpness) or not 1e-3 <= sharpness <= 1e6:
            raise ValueError(f"sharpness: expected a number from 0.001 to 1e6, got {sharpness!r}")
        self.sharpness = sharpness

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        rows, owner = pack(vehicles, mask)
        # Scaled where it is small: what has d3 numbers for each vehicle takes the time.
        weight, bias = (self.sharpness * each for each in (self.output.weight, self.output.bias))
        exponents = functional.linear(self.layers(rows), weight, bias)
        total = segment_sum(exponents.clamp(-self.LIMIT, self.LIMIT).exp_(), owner, len(mask))
        return total.log1p() / self.sharpness


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
        check_positive(heads=heads)
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
