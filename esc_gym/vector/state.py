"""Everything that the future of a batch depends on, in flat arrays: one row per environment."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields

import numpy as np

from esc_gym.fastsim.records import VEHICLE
from esc_gym.vector.generators import SIZE

# time [s], steps (sub-steps so far), elapsed (policy steps), over (see ``kernel.RUNNING``),
# next_id (of the vehicle perceived next).
HEAD = np.dtype(
    [("time", "f8")] + [(name, "i8") for name in ("steps", "elapsed", "over", "next_id")]
)
# Rows of ``generators``: highway-env's own, and that of the order "shuffled".
ROAD, SHUFFLE = range(2)


@dataclass
class State:
    """E environments with room for m vehicles and objects each.

    vehicles: VEHICLE [E, m + 1], the last one scratch. counts [E, 4]: see ``fastsim.kernel``.
    routes [E, m, R, 2]: see ``fastsim.records.Scene``. ids [E, m]: see ``observe``.
    heads: HEAD [E]. generators: uint64 [E, 2, 6].
    """

    vehicles: np.ndarray
    counts: np.ndarray
    routes: np.ndarray
    ids: np.ndarray
    heads: np.ndarray
    generators: np.ndarray

    @classmethod
    def empty(cls, count: int, items: int, route_length: int) -> State:
        return cls(
            np.zeros((count, items + 1), VEHICLE),
            np.zeros((count, 4), np.int64),
            np.zeros((count, items, route_length, 2), np.int64),
            np.full((count, items), -1),
            np.zeros(count, HEAD),
            np.zeros((count, 2, SIZE), np.uint64),
        )

    def arrays(self) -> tuple[np.ndarray, ...]:
        return tuple(getattr(self, field.name) for field in fields(self))

    def taken(self, indices: np.ndarray) -> State:
        """Copies of some environments, as many times as asked for."""
        return State(*(array.take(indices, axis=0) for array in self.arrays()))

    def to_bytes(self) -> bytes:
        content = b"".join(array.tobytes() for array in self.arrays())
        return hashlib.sha256(content).digest() + content

    def load(self, data: bytes) -> None:
        """Take what ``to_bytes`` gave of a state of the same shape.

        Raises ValueError, and changes nothing, if the bytes are not that.
        """
        digest, content = data[:32], data[32:]
        expected = sum(array.nbytes for array in self.arrays())
        if len(content) != expected or hashlib.sha256(content).digest() != digest:
            raise ValueError(f"the snapshot is damaged: {len(data):,} bytes of {expected + 32:,}")
        place = 0
        for array in self.arrays():
            part = np.frombuffer(content, array.dtype, array.size, place)
            array[:] = part.reshape(array.shape)
            place += array.nbytes
