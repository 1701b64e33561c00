"""Equal sizes for a fair comparison: hidden widths that give encoders as many parameters."""

from __future__ import annotations

import warnings
from bisect import bisect_left
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn

from esc_gym.encoders import DEFAULT_HIDDEN, ESCEncoder, SetEncoder, representation


def parameter_count(module: nn.Module) -> int:
    """Number of trainable parameters."""
    return sum(p.numel() for p in module.parameters() if p.requires_grad)


def matched_hidden(
    encoder: str | type[SetEncoder], *, hidden: Sequence[int] = DEFAULT_HIDDEN, **settings: Any
) -> tuple[int, ...]:
    """Hidden widths, all scaled alike, with which ``encoder`` is as large as ESC with ``hidden``.

    settings: the encoder's other arguments. Warns where the nearest is more than 5 % off.
    """
    cls = representation(encoder) if isinstance(encoder, str) else encoder
    dims = ("vehicle_dim", "ego_dim", "max_vehicles", "code_dim")
    target = _count(ESCEncoder, hidden, {name: settings[name] for name in dims if name in settings})

    def scaled(widest: int) -> tuple[int, ...]:
        return tuple(max(1, round(widest * width / max(hidden))) for width in hidden)

    # Counts grow with the widths: bisection finds the first that is at least as large as ESC.
    widest = range(1, 1 << 16)
    first = bisect_left(widest, target, key=lambda width: _count(cls, scaled(width), settings))
    pair = [scaled(widest[max(first - 1, 0)]), scaled(widest[min(first, len(widest) - 1)])]
    nearest = min(pair, key=lambda widths: abs(_count(cls, widths, settings) - target))
    count = _count(cls, nearest, settings)
    if abs(count - target) > 0.05 * target:
        warnings.warn(
            f"{cls.__name__}: {count} parameters with hidden={nearest}, the nearest to ESC's "
            f"{target}, is more than 5 % off",
            stacklevel=2,
        )
    return nearest


def _count(cls: type[SetEncoder], hidden: Sequence[int], settings: dict[str, Any]) -> int:
    # On the meta device nothing is allocated and no random number is drawn.
    with torch.device("meta"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return parameter_count(cls(hidden=hidden, **settings))
