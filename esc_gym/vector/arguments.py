"""What users give to a vector environment, checked. All raise ValueError with what was expected."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode


def at_least_one(name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
        raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}.")
    return int(value)


def mode_of(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode: expected one of {known}; got {mode!r}.") from None


def index_of(index: Any, count: int) -> int:
    if not -count <= index < count:
        raise ValueError(f"expected an environment from 0 to {count - 1}, got {index!r}.")
    return int(index) % count


def seeds_of(seed: Any, count: int) -> list[int | None]:
    if seed is None:
        return [None] * count
    if isinstance(seed, int | np.integer):
        return [int(seed) + i for i in range(count)]
    seeds = [None if s is None else int(s) for s in seed]
    if len(seeds) != count:
        raise ValueError(
            f"seed: expected {count} seeds, one for each environment, got {len(seeds)}."
        )
    return seeds


def mask_of(mask: Any, count: int) -> np.ndarray:
    if mask is None:
        return np.ones(count, bool)
    if not isinstance(mask, np.ndarray) or mask.shape != (count,) or mask.dtype != bool:
        raise ValueError(f"options['reset_mask']: expected a bool array of shape ({count},).")
    if not mask.any():
        raise ValueError("options['reset_mask']: expected at least one environment to reset.")
    return mask.copy()
