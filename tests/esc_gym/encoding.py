"""What the tests of encoders share: small encoders of every kind, and scenes for them."""

from typing import Any

import torch
from hypothesis import strategies as st
from torch import Tensor

from esc_gym.encoders import (
    REPRESENTATIONS,
    APEncoder,
)

D1, D2, N = 3, 2, 6
DIMS: dict[str, Any] = {"vehicle_dim": D1, "ego_dim": D2, "max_vehicles": N, "hidden": (16, 8)}
NAMES = sorted(REPRESENTATIONS)
POOLING = [name for name in NAMES if not issubclass(REPRESENTATIONS[name], APEncoder)]
TOLERANCE: Any = {"rtol": 1e-5, "atol": 1e-5}
scenes = st.tuples(st.integers(0, 2**31), st.lists(st.integers(0, N), min_size=1, max_size=5))


def build(name: str, **kwargs) -> Any:
    torch.manual_seed(0)
    return REPRESENTATIONS[name](**{**DIMS, **kwargs})


def scene(counts: list[int], seed: int = 0, rows: int = N) -> tuple[Tensor, Tensor, Tensor]:
    """Random sets of the given sizes: vehicles [B, rows, D1] with zero padding, mask, ego."""
    random = torch.Generator().manual_seed(seed)
    mask = torch.arange(rows) < torch.tensor(counts, dtype=torch.long)[:, None]
    vehicles = torch.rand(len(counts), rows, D1, generator=random) * 2 - 1
    ego = torch.rand(len(counts), D2, generator=random)
    return vehicles * mask[:, :, None], mask.to(torch.int8), ego


def gradients(encoder: Any, output: Tensor) -> dict[str, Tensor]:
    """Gradients of a loss in which every output counts differently; zero where unused."""
    weights = torch.linspace(-1, 2, output.numel()).view_as(output)
    names, parameters = zip(*encoder.named_parameters(), strict=True)
    # Without vehicles the naive formula never touches the weights: its gradient is zero.
    loss = (weights * output).sum() + 0 * sum(p.sum() for p in parameters)
    found = torch.autograd.grad(loss, parameters, retain_graph=True)
    return dict(zip(names, found, strict=True))
