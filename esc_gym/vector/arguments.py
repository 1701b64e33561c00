"""What users give to a vector environment, checked. All raise ValueError with what was expected."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector import AutoresetMode


def at_least_one(name: str, value: Any) -> int:
    if not whole(value) or value < 1:
        raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}.")
    return int(value)


def mode_of(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode: expected one of {known}; got {mode!r}.") from None


def whole(value: Any) -> bool:
    """Whether it is a whole number, and none by chance, as True is."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def index_of(index: Any, count: int) -> int:
    """The number of an environment; from the end, if negative."""
    if not whole(index) or not -count <= index < count:
        raise ValueError(f"expected the number of an environment, 0 to {count - 1}, got {index!r}.")
    return int(index) % count


def _listed(values: Any) -> list[Any]:
    """The values of a sequence; what is none, as the only one."""
    return list(values) if np.iterable(values) and not isinstance(values, str) else [values]


def indices_of(indices: Any, count: int) -> np.ndarray:
    """The numbers of environments, at least one."""
    indices = _listed(indices)
    if not indices:
        raise ValueError("indices: expected at least one environment, got none.")
    return np.array([index_of(index, count) for index in indices], np.int64)


def seeds_of(seed: Any, count: int) -> list[int | None]:
    """A seed for each environment, or None."""
    if seed is None:
        return [None] * count
    seeds = [seed + i for i in range(count)] if whole(seed) else _listed(seed)
    if not all(s is None or (whole(s) and s >= 0) for s in seeds):
        raise ValueError(f"seed: expected whole numbers of at least 0, or None, got {seed!r}.")
    if len(seeds) != count:
        raise ValueError(
            f"seed: expected {count} seeds, one for each environment, got {len(seeds)}."
        )
    return [None if s is None else int(s) for s in seeds]


def mask_of(mask: Any, count: int, name: str) -> np.ndarray:
    """A copy of a mask of environments."""
    if not isinstance(mask, np.ndarray) or mask.shape != (count,) or mask.dtype != bool:
        raise ValueError(f"{name}: expected a bool array of shape ({count},), got {mask!r}.")
    return mask.copy()


def actions_of(actions: Any, space: gym.Space, count: int) -> np.ndarray:
    """A batch of actions as an array of the shape that the action space has."""
    try:
        actions = np.asarray(actions)
    except ValueError:
        raise ValueError(f"actions: expected one array, got {actions!r}.") from None
    shape = (count, *(space.shape or ()))
    if actions.shape != shape:
        raise ValueError(f"actions: expected shape {shape}, got {actions.shape}.")
    if isinstance(space, gym.spaces.Box):
        if not np.issubdtype(actions.dtype, np.number) or not np.isfinite(actions).all():
            raise ValueError("actions: expected finite numbers, got NaN, infinity or no numbers.")
    elif not np.issubdtype(actions.dtype, np.integer):
        raise ValueError(f"actions: expected whole numbers, got {actions.dtype}.")
    elif isinstance(space, gym.spaces.Discrete):
        bad = (actions < 0) | (actions >= space.n)
        if bad.any():
            raise ValueError(f"actions: expected 0 to {space.n - 1}, got {actions[bad][0]}.")
    return actions
