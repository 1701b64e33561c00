"""A representation of your own: one class and one registry line; esc-train takes it at once."""

import sys
from pathlib import Path

import torch
from torch import Tensor, nn

from esc_agents.config import EvaluationConfig, config_for_env
from esc_agents.training.train import train
from esc_gym.encoders import REPRESENTATIONS, SetEncoder


class Histogram(SetEncoder):
    """Where the vehicles are, lengthwise: a histogram of their first feature."""

    permutation_invariant = True

    def __init__(self, **dims) -> None:
        super().__init__(**dims)
        self.output = nn.Sequential(
            nn.Linear(20, self.hidden[0]), nn.GELU(), nn.Linear(self.hidden[0], self.code_dim)
        )

    def encode(self, vehicles: Tensor, mask: Tensor, ego: Tensor) -> Tensor:
        bins = torch.linspace(-1, 1, 20, device=vehicles.device)
        near = torch.exp(-50 * (vehicles[:, :, :1] - bins) ** 2)
        return self.output((near * mask[:, :, None]).sum(dim=1))


REPRESENTATIONS["histogram"] = Histogram

if __name__ == "__main__":
    steps = int(sys.argv[1]) if len(sys.argv) > 1 else 20_000
    run_dir = Path(sys.argv[2]) if len(sys.argv) > 2 else None
    update = {"repr": "histogram", "steps": steps, "run_dir": run_dir}
    update["evaluation"] = EvaluationConfig(episodes=3)  # few, so that the example ends soon
    train(config_for_env("highway-fast").model_copy(update=update))
