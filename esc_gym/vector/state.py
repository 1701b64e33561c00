"""Everything that the future of a batch depends on, in flat arrays: one row per environment."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields

import numpy as np

from esc_gym.fastsim.records import VEHICLE
from esc_gym.vector.generators import SIZE

# time [s], steps (sub-steps so far), elapsed (policy steps), over (see RUNNING),
# next_id (of the vehicle perceived next), single (the last action was in single precision), lane
# (whose place the ego is told: the exit's, or that to keep; -1), seed (of the generator; -1 if
# unknown).
HEAD = np.dtype(
    [("time", "f8")]
    + [(name, "i8") for name in ("steps", "elapsed", "over", "next_id", "single", "lane", "seed")]
)
HEADER = b"esc_gym snapshot 3\n"
# Values of ``over``; RESTING: left alone until it is reset; UNBORN: never reset.
RUNNING, ENDED, RESTING, UNBORN = range(4)
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
        heads = np.zeros(count, HEAD)
        heads["lane"] = heads["seed"] = -1
        heads["over"] = UNBORN
        return cls(
            np.zeros((count, items + 1), VEHICLE),
            np.zeros((count, 4), np.int64),
            np.zeros((count, items, route_length, 2), np.int64),
            np.full((count, items), -1),
            heads,
            np.zeros((count, 2, SIZE), np.uint64),
        )

    def arrays(self) -> tuple[np.ndarray, ...]:
        return tuple(getattr(self, field.name) for field in fields(self))

    def taken(self, indices: np.ndarray) -> State:
        """Copies of some environments, as many times as asked for."""
        return State(*(array.take(indices, axis=0) for array in self.arrays()))


def _marks(identity: Mapping[str, object]) -> list[bytes]:
    """A fingerprint of each part of what a snapshot is of."""
    return [hashlib.sha256(repr(part).encode()).digest() for part in identity.values()]


def packed(arrays: Sequence[np.ndarray], identity: Mapping[str, object]) -> bytes:
    """The content of arrays as bytes. identity: what they are of, by name."""
    content = b"".join([*_marks(identity), *(array.tobytes() for array in arrays)])
    return HEADER + hashlib.sha256(content).digest() + content


def unpack(data: bytes, arrays: Sequence[np.ndarray], identity: Mapping[str, object]) -> None:
    """Write into ``arrays`` what ``packed`` took from others of the same shapes.

    Raises ValueError, and writes nothing, if the bytes are not that.
    """
    start = len(HEADER)
    if not isinstance(data, bytes | bytearray):
        raise ValueError(f"snapshot: expected bytes, got {type(data).__name__}")
    if data[:start] != HEADER:
        raise ValueError(
            f"snapshot: expected bytes that begin with {HEADER!r}, got {data[:start]!r}; it is "
            "damaged, or of another version of esc_gym"
        )
    digest, content = data[start : start + 32], data[start + 32 :]
    if hashlib.sha256(content).digest() != digest:
        raise ValueError(
            f"snapshot: damaged; its {len(data):,} bytes do not match their checksum; take another"
        )
    theirs = [content[place : place + 32] for place in range(0, 32 * len(identity), 32)]
    pairs = zip(identity, _marks(identity), theirs, strict=True)
    other = [name for name, mine, there in pairs if mine != there]
    if other:
        raise ValueError(
            f"snapshot: of other environments; their {', '.join(other)} should be as here"
        )
    place = 32 * len(identity)
    for array in arrays:
        part = np.frombuffer(content, array.dtype, array.size, place)
        array[...] = part.reshape(array.shape)
        place += array.nbytes
