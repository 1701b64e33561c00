"""Training episodes that begin shortly before a collision of an earlier one."""

from __future__ import annotations

import pickle
import zlib
from collections import deque

import numpy as np

from esc_gym.vector.environment import SetVectorEnv

# Every how many policy steps states are kept, and how many of each environment.
EVERY, COPIES = 3, 5
# A replay begins that many steps before the collision at least, and ends so many after its moment.
LEAST, BEYOND = 3, 8
CRASHES = 200  # the latest ones are replayed


class CrashReplay:
    """Lets a share of the episodes of a batch begin some steps before an earlier collision.

    Whether a good driver crashes is decided in a few near states, which it meets too rarely to
    learn from. Here episodes start from them, too (Salimans & Chen 2018, "Learning Montezuma's
    Revenge from a Single Demonstration"; Ecoffet et al. 2021, "First return, then explore").
    Rewards and traffic are the scenario's. Collisions of replays are not replayed: what nobody can
    survive would soon be all there is.

    envs: the batch. share: of the episodes, 0 to 1. waits: steps of the batch before the first
    replay, while a beginner still collides everywhere. seed: of the choices.
    """

    def __init__(self, envs: SetVectorEnv, share: float, waits: int, seed: int) -> None:
        self.envs, self.share, self.waits = envs, share, waits
        self._steps = 0
        self._generator = np.random.default_rng([seed, 0xC4A5])
        self._past: deque[tuple[np.ndarray, ...]] = deque(maxlen=COPIES)
        self._since = 0  # steps since the last of them
        # (steps before the collision, state); steps until a replay ends, -1 in a whole episode.
        self._crashes: deque[tuple[int, tuple[np.ndarray, ...]]] = deque(maxlen=CRASHES)
        self._left = np.full(envs.num_envs, -1)

    @property
    def replaying(self) -> np.ndarray:
        """Which environments are in a replay [num_envs]."""
        return self._left >= 0

    def state(self) -> bytes:
        """What a checkpoint has to hold; padding makes most of it, so it is compressed."""
        future = {name: part for name, part in vars(self).items() if name[0] == "_"}
        return zlib.compress(pickle.dumps(future), 1)

    def restore(self, state: bytes) -> None:
        vars(self).update(pickle.loads(zlib.decompress(state)))

    def before_step(self) -> None:
        self._steps += 1
        self._since += 1
        if self._since >= EVERY or not self._past:
            self._past.append(self.envs.keep(range(self.envs.num_envs)))
            self._since = 0

    def after_step(self, crashed: np.ndarray, lengths: np.ndarray) -> np.ndarray:
        """Which replays are over now [num_envs].

        crashed: whose episode ended in a collision. lengths: steps of the episodes so far.
        """
        for e in np.flatnonzero(crashed & ~self.replaying).tolist():
            ages = [self._since + 1 + EVERY * i for i in range(len(self._past))]
            usable = [i for i, age in enumerate(ages) if LEAST <= age <= lengths[e]]
            if usable:
                i = usable[self._generator.integers(len(usable))]
                kept = tuple(array[e : e + 1].copy() for array in self._past[-1 - i])
                self._crashes.append((ages[i], kept))
        self._left -= self.replaying
        return self._left == 0

    def begin(self, chosen: np.ndarray) -> np.ndarray:
        """Which of the episodes that have just begun, of ``chosen``, are replays [num_envs]."""
        self._left[chosen] = -1
        ready = self._crashes and self._steps >= self.waits
        for e in np.flatnonzero(chosen).tolist():
            if ready and self._generator.random() < self.share:
                before, kept = self._crashes[self._generator.integers(len(self._crashes))]
                self.envs.go_back([e], kept)
                self._left[e] = before + BEYOND
        return chosen & self.replaying
