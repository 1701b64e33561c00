"""The paper's mathematics, executable: which sets a sum of encodings can tell apart. Only NumPy.

N = ``max_vehicles``, d1 = ``vehicle_dim``; a set is an array [M, d1] with M <= N and values in
[-1, 1]. The paper scales to [0, 1]; its lemma on sums of powers holds for any real numbers, and
powers of numbers around 0 are inverted two to four digits more exactly. A code is a vector of
N*d1 + 1 numbers, the least that Theorem 1 asks for, summed over the set.

The encoding in the proof of Theorem 1 is ``column_code``. It determines the values of each feature,
but not which of them belong to the same vehicle: {(0, 0), (1, 1)} and {(0, 1), (1, 0)} have one and
the same code. For d1 = 1 there is nothing to confuse, and the proof is complete. ``linked_code`` is
a sum of as many numbers from which the vehicles come back whole wherever their first features
differ.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

# First features closer than this are the same: what the roots of a polynomial can tell apart.
RESOLUTION = 1e-5


def required_code_dim(max_vehicles: int, vehicle_dim: int) -> int:
    """d3 = N*d1 + 1, the rule of Theorem 1."""
    return max_vehicles * vehicle_dim + 1


def column_code(vehicles: ArrayLike, max_vehicles: int) -> NDArray[np.float64]:
    """The code in the proof of Theorem 1: sums of the powers 1..N of each feature, and M.

    Returns [N*d1 + 1]: N numbers for the first feature, N for the second, ..., the count.
    """
    vehicles = _checked_set(vehicles, max_vehicles)
    powers = vehicles[:, :, None] ** np.arange(1, max_vehicles + 1)
    return np.append(powers.sum(axis=0).ravel(), len(vehicles))


def columns(code: ArrayLike, max_vehicles: int) -> NDArray[np.float64]:
    """All that ``column_code`` keeps: the values of each feature in increasing order, [d1, M].

    By Newton's identities and the roots of a polynomial. Up to N = 8 random values come back to
    about 1e-6 at worst, mostly to 1e-12; m equal ones to the m-th root of the rounding.
    """
    blocks, count = _checked_code(code, max_vehicles)
    return np.stack([_from_power_sums(block[:count]) for block in blocks])


def linked_code(vehicles: ArrayLike, max_vehicles: int) -> NDArray[np.float64]:
    """Sums of the powers 1..N of the first feature a, of a^0..a^(N-1) times each other one, and M.

    Returns [N*d1 + 1], in the order of ``column_code``.
    """
    vehicles = _checked_set(vehicles, max_vehicles)
    first = vehicles[:, :1]
    powers = first ** np.arange(max_vehicles)
    factors = np.concatenate([first, vehicles[:, 1:]], axis=1)
    return np.append((factors.T @ powers).ravel(), len(vehicles))


def vehicles(code: ArrayLike, max_vehicles: int) -> NDArray[np.float64]:
    """The set [M, d1] of a ``linked_code``, in increasing order of the first feature.

    Raises ValueError where two first features are closer than ``RESOLUTION``: of such vehicles the
    code keeps only the sum of the other features.
    """
    blocks, count = _checked_code(code, max_vehicles)
    first = _from_power_sums(blocks[0, :count])
    if (gap := np.diff(first).min(initial=np.inf)) < RESOLUTION:
        raise ValueError(
            f"two vehicles share their first feature to {gap:.1g}: expected {RESOLUTION:g} between "
            "them. Their other features cannot be told apart; put first a feature that differs."
        )
    # sum_i a_i^k y_i, k = 0..M-1, is a linear system in the y_i.
    powers = first ** np.arange(count)[:, None]
    others = np.linalg.solve(powers, blocks[1:, :count].T)
    return np.column_stack([first, others]).astype(np.float64)


def _from_power_sums(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """The M real numbers, in increasing order, whose powers 1..M add up to ``sums`` [M]."""
    elementary = np.ones(len(sums) + 1)
    for k in range(1, len(sums) + 1):
        signs = (-1.0) ** np.arange(k)
        elementary[k] = (signs * elementary[k - 1 :: -1][:k] * sums[:k]).sum() / k
    signs = (-1.0) ** np.arange(len(elementary))
    roots = np.roots(signs * elementary)
    return np.sort(roots.real).astype(np.float64)  # equal numbers come out as complex pairs


def _checked_set(vehicles: ArrayLike, max_vehicles: int) -> NDArray[np.float64]:
    found = np.asarray(vehicles, dtype=np.float64)
    if found.ndim != 2 or found.shape[1] < 1:
        raise ValueError(f"vehicles: expected shape [M, d1] with d1 >= 1, got {found.shape}")
    if len(found) > max_vehicles:
        raise ValueError(f"vehicles: expected at most N = {max_vehicles}, got {len(found)}")
    if not (np.abs(found) <= 1).all():
        raise ValueError("vehicles: expected values in [-1, 1]; scale them as SetObservation does")
    return found


def _checked_code(code: ArrayLike, max_vehicles: int) -> tuple[NDArray[np.float64], int]:
    """([d1, N] power sums, M)."""
    found = np.asarray(code, dtype=np.float64)
    if found.ndim != 1 or len(found) <= max_vehicles or (len(found) - 1) % max_vehicles:
        raise ValueError(f"code: expected N*d1 + 1 numbers, N = {max_vehicles}, got {found.shape}")
    count = round(found[-1])
    if not 0 <= count <= max_vehicles:
        raise ValueError(f"code: expected a count in 0..{max_vehicles}, got {found[-1]:g}")
    return found[:-1].reshape(-1, max_vehicles), count
