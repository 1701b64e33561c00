"""Operations on padded sets: rows [B, N, ...] of which a mask [B, N] says which are real.

Shapes: B = batch, N = rows of the padded set, M = real rows of one set.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def all_real(vehicles: Tensor) -> Tensor:
    """The mask of sets without padding: one number, repeated without being stored [B, N]."""
    return torch.ones((), dtype=torch.bool, device=vehicles.device).expand(vehicles.shape[:2])


def is_all_real(mask: Tensor) -> bool:
    """Whether a mask is that of ``all_real``, which is known without looking at its values."""
    return mask.stride() == (0, 0)


def pack(vehicles: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """All real rows of a batch [sum M, d1], and the set that each belongs to [sum M].

    Padding is left out before it is computed: cheaper, and nothing in it can leak.
    """
    if is_all_real(mask):
        sets = torch.arange(len(vehicles), device=vehicles.device)
        return vehicles.flatten(0, 1), sets.repeat_interleave(vehicles.shape[1])
    owner, row = mask.nonzero(as_tuple=True)
    return vehicles[owner, row], owner


def segment_sum(values: Tensor, owner: Tensor, size: int) -> Tensor:
    """values [sum M, ...] summed by owner -> [size, ...]; sets without rows get 0."""
    # As fast in forward + backward as segment_reduce, CSR and embedding_bag, and the simplest.
    return values.new_zeros(size, *values.shape[1:]).index_add_(0, owner, values)


def segment_max(values: Tensor, owner: Tensor, size: int) -> Tensor:
    """values [sum M, k], largest by owner -> [size, k]; sets without rows get 0."""
    index = owner[:, None].expand_as(values)
    zeros = values.new_zeros(size, values.shape[1])
    return zeros.scatter_reduce(0, index, values, "amax", include_self=False)


def leading(mask: Tensor, size: int) -> Tensor:
    """[B, size], true in the first M places of each set."""
    return torch.arange(size, device=mask.device) < mask.sum(dim=1, keepdim=True)


def ordering(key: Tensor, mask: Tensor) -> Tensor:
    """Rows [B, N] by increasing key [B, N], padding last; stable, so ties keep their order."""
    return key.masked_fill(~mask, math.inf).argsort(dim=1, stable=True)


def take(rows: Tensor, order: Tensor) -> Tensor:
    """rows [B, N, d1] in an order [B, k] -> [B, k, d1]."""
    return rows.gather(1, order[:, :, None].expand(-1, -1, rows.shape[2]))
