"""ESC's packed evaluation against the padded formula, and against h alone on the real rows.

B = 256 sets, N = 50 rows, d1 = 7 features, M uniform in 4..12, hidden (256, 256), two threads,
forward and backward. The acceptance line (8x) is for the default d3 = N*d1 + 1 = 351. At d3 = 64
the output layer is too small for much to be saved by applying it after the sum, and skipping the
padding alone is worth N / mean M = 6.25.
"""

import warnings
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

from esc_gym.encoders import ESCEncoder
from tests.benchmarks.interleaved import fastest, torch_threads

B, N, D1, D2 = 256, 50, 7, 9


@pytest.fixture(autouse=True)
def _two_threads() -> Iterator[None]:
    with torch_threads(2):
        yield


def contenders(code_dim: int) -> dict[str, Callable[[], Tensor]]:
    """The three ways to the same gradients (h alone: no sum), each with its backward pass."""
    torch.manual_seed(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # d3 = 64 is below the rule, on purpose
        encoder = ESCEncoder(
            vehicle_dim=D1, ego_dim=D2, max_vehicles=N, hidden=(256, 256), code_dim=code_dim
        )
    mask = (torch.arange(N) < torch.randint(4, 13, (B, 1))).float()
    vehicles, ego = (torch.rand(B, N, D1) * 2 - 1) * mask[:, :, None], torch.rand(B, D2)
    rows = vehicles[mask.bool()]

    def h(x: Tensor) -> Tensor:
        return encoder.output(encoder.layers(x))

    def padded() -> Tensor:
        return torch.cat([(h(vehicles) * mask[:, :, None]).sum(1), ego], dim=1)

    def with_backward(forward: Callable[[], Tensor]) -> Callable[[], Tensor]:
        grad = torch.randn_like(forward())

        def run() -> Tensor:
            encoder.zero_grad()
            output = forward()
            output.backward(grad)
            return output

        return run

    return {
        "esc": with_backward(lambda: encoder(vehicles, mask, ego)),
        "padded": with_backward(padded),
        "h alone": with_backward(lambda: h(rows)),
    }


@pytest.mark.parametrize(("code_dim", "speedup"), [(N * D1 + 1, 8.0), (64, 5.0)])
def test_esc_costs_what_its_vehicles_cost(benchmark: Any, code_dim: int, speedup: float) -> None:
    runs = contenders(code_dim)
    torch.testing.assert_close(runs["esc"](), runs["padded"](), rtol=1e-4, atol=1e-5)
    best = fastest(runs)
    benchmark.pedantic(runs["esc"], rounds=5)
    benchmark.extra_info |= {
        "padded / esc": best["padded"] / best["esc"],
        "esc / h alone": best["esc"] / best["h alone"],
    }
    print({name: round(ratio, 2) for name, ratio in benchmark.extra_info.items()})  # noqa: T201
    assert best["padded"] >= speedup * best["esc"]
    assert best["esc"] <= 1.5 * best["h alone"]
