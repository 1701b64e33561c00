"""The paper's data: a million training samples and 2048 test samples, none of them stored.

Every number of every sample is a hash of (seed, split, sample, place), in integer arithmetic that
is the same on every device: a sample is drawn when it is needed, wherever it is needed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal

import torch
from torch import Tensor

from esc_agents.paper.targets import EGO_DIM, HIGH, LOW, MAX_VEHICLES, VEHICLE_DIM, Sets

Split = Literal["train", "test"]
COUNTS: dict[Split, int] = {"train": 1_000_000, "test": 2048}
# Places of a sample's numbers: the vehicles', the ego's, the size of the set.
_VEHICLES = MAX_VEHICLES * VEHICLE_DIM
_PLACES = _VEHICLES + EGO_DIM + 1


@dataclass(frozen=True)
class Samples:
    """One split of the data of one seed, or of several at once, then with a dimension for them [S].

    size: M of every set, or None for M uniform in 1..20. The sets of different sizes are nested:
    the first five vehicles are the same whatever M is.
    """

    split: Split
    seed: int | tuple[int, ...]
    size: int | None

    def draw(self, index: Tensor) -> Sets:
        """Samples by their numbers, int64 [(S,) B] in 0..COUNTS - 1: values uniform in [-5, 5)."""
        rows = MAX_VEHICLES if self.size is None else self.size
        vehicles = self._uniform(index, 0, rows * VEHICLE_DIM).unflatten(-1, (rows, VEHICLE_DIM))
        ego = self._uniform(index, _VEHICLES, EGO_DIM)
        if self.size is not None:
            return Sets(vehicles, None, ego)
        sizes = 1 + _below(MAX_VEHICLES, self._bits(index, _VEHICLES + EGO_DIM, 1))
        mask = torch.arange(rows, device=index.device) < sizes
        return Sets(vehicles * mask[..., None], mask, ego)

    def batch(self, update: int | Tensor, size: int, device: torch.device | str = "cpu") -> Tensor:
        """Numbers of the samples of one mini-batch, drawn with replacement: int64 [(S,) size]."""
        places = torch.arange(size, device=device) + update * size
        key = self._key(places, "batch", self.split)
        return _below(COUNTS[self.split], _scramble(places, key))

    def all(self, device: torch.device | str = "cpu") -> Sets:
        """The whole split."""
        return self.draw(torch.arange(COUNTS[self.split], device=device))

    def _bits(self, index: Tensor, place: int, count: int) -> Tensor:
        """[(S,) B, count] integers of 32 bits."""
        places = torch.arange(place, place + count, device=index.device)
        counter = index[..., None] * _PLACES + places
        return _scramble(counter, self._key(counter[0], self.split))

    def _key(self, like: Tensor, *parts: str) -> int | Tensor:
        """A seed's key, or those of several seeds [S, 1, ...], to add to ``like`` for each."""
        if isinstance(self.seed, int):
            return _key(self.seed, *parts)
        return _keys(self.seed, parts, like.device).view(-1, *[1] * like.dim())

    def _uniform(self, index: Tensor, place: int, count: int) -> Tensor:
        # 24 bits: as many as a float32 holds exactly.
        fraction = (self._bits(index, place, count) >> 8).to(torch.float32) * 2.0**-24
        return LOW + (HIGH - LOW) * fraction


def _key(*parts: int | str) -> int:
    """A signed 64-bit number that depends on all of ``parts``, the same in every process."""
    key = 0
    for part in parts:
        for byte in str(part).encode() + b"\0":
            key = _mix((key ^ byte) * 0x9E3779B97F4A7C15 & _MASK)
    return _signed(key)


@cache  # copied to a device only once: within a CUDA graph nothing can be
def _keys(seeds: tuple[int, ...], parts: tuple[str, ...], device: torch.device) -> Tensor:
    return torch.tensor([_key(seed, *parts) for seed in seeds], device=device)


_MASK = (1 << 64) - 1


def _mix(z: int) -> int:
    """The finaliser of SplitMix64 (Steele, Lea and Flood, 2014)."""
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9 & _MASK
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB & _MASK
    return z ^ (z >> 31)


def _signed(number: int) -> int:
    return number - (number >> 63 << 64)


def _scramble(counter: Tensor, key: int | Tensor) -> Tensor:
    """The upper 32 bits of SplitMix64's output number ``counter`` from the state ``key``."""
    z = counter * _signed(0x9E3779B97F4A7C15) + key  # int64 wraps around, as it has to
    z = (z ^ (z >> 30 & (1 << 34) - 1)) * _signed(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> 27 & (1 << 37) - 1)) * _signed(0x94D049BB133111EB)
    z = z ^ (z >> 31 & (1 << 33) - 1)
    return z >> 32 & (1 << 32) - 1


def _below(limit: int, bits: Tensor) -> Tensor:
    """Integers of 32 bits, scaled down to 0..limit - 1."""
    return bits * limit >> 32
