"""What all encoders share: the shape of a code, checks of tensors and settings, hidden layers."""

from __future__ import annotations

import inspect
import math
from collections.abc import Sequence
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor, nn

from esc_gym.sets import all_real

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
        **unknown: Any,
    ) -> None:
        super().__init__()
        if unknown:
            raise TypeError(
                f"{type(self).__name__} takes {', '.join(_options(type(self)))}; got "
                f"{', '.join(unknown)}"
            )
        self.hidden = tuple(hidden)
        if not self.hidden:
            raise ValueError("hidden: expected at least one width, got none")
        widths = {f"hidden[{i}]": width for i, width in enumerate(self.hidden)}
        check_positive(
            vehicle_dim=vehicle_dim, ego_dim=ego_dim, max_vehicles=max_vehicles, **widths
        )
        self.vehicle_dim, self.ego_dim, self.max_vehicles = vehicle_dim, ego_dim, max_vehicles
        self.required_code_dim = max_vehicles * vehicle_dim + 1
        self.code_dim = self.required_code_dim if code_dim is None else code_dim
        check_positive(code_dim=self.code_dim)
        if not is_number(scale) or not 0 < abs(scale) < math.inf:
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


def _options(encoder: type[SetEncoder]) -> list[str]:
    """Arguments that an encoder, or a class that it derives from, has a default for."""
    makers = [cls.__init__ for cls in encoder.__mro__ if "__init__" in vars(cls)]
    return [
        name for maker in makers for name, parameter in inspect.signature(maker).parameters.items()
        if parameter.default is not parameter.empty
    ]  # fmt: skip


def is_number(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool)


def check_positive(**values: Any) -> None:
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
