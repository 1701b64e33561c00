"""Training episodes that begin shortly before a collision of an earlier one."""

from __future__ import annotations

import pickle
import zlib
from collections import deque
from dataclasses import dataclass

import numpy as np

from esc_gym.vector.environment import SetVectorEnv

# Every how many policy steps states are kept, and how many of each environment.
EVERY, COPIES = 3, 5
# A replay begins that many steps before the collision at least, and ends so many after its moment.
LEAST, BEYOND = 3, 8
CRASHES = 200  # the latest ones are replayed
PACE = 0.2  # of a crash's danger, after each of its replays
SELDOM = 0.02  # what its chances of a replay have at least; without it, at most 0.25


@dataclass
class Crash:
    """What is replayed: the state ``before`` steps before a collision, of ``SetVectorEnv.keep``.

    danger: how often its replays have ended in a collision of late, 0 to 1.
    """

    before: int
    kept: tuple[np.ndarray, ...]
    danger: float = 0.5

    @property
    def weight(self) -> float:
        """Least where nobody can survive any more, and where the driver always does."""
        return self.danger * (1 - self.danger) + SELDOM


class CrashReplay:
    """Lets a share of the episodes of a batch begin some steps before an earlier collision.

    Whether a good driver crashes is decided in a few near states, which it meets too rarely to
    learn from. Here episodes start from them, too (Salimans & Chen 2018, "Learning Montezuma's
    Revenge from a Single Demonstration"; Ecoffet et al. 2021, "First return, then explore").
    Rewards and traffic are the scenario's. Those are replayed most that go either way (Florensa et
    al. 2017, "Reverse Curriculum Generation for Reinforcement Learning"). Collisions of replays are
    not replayed: what nobody can survive would soon be all there is.

    envs: the batch. share: of the episodes, 0 to 1. waits: steps of the batch before the first
    replay, while a beginner still collides everywhere. seed: of the choices.
    """

    def __init__(self, envs: SetVectorEnv, share: float, waits: int, seed: int) -> None:
        self.envs, self.share, self.waits = envs, share, waits
        self._steps = 0
        self._generator = np.random.default_rng([seed, 0xC4A5])
        self._past: deque[tuple[np.ndarray, ...]] = deque(maxlen=COPIES)
        self._since = 0  # steps since the last of them
        self._crashes: deque[Crash] = deque(maxlen=CRASHES)
        # Of each environment: steps until its replay ends, -1 in a whole episode; what it replays,
        # or did last; whether that has just ended in a collision.
        self._left = np.full(envs.num_envs, -1)
        self._replayed = [Crash(0, ())] * envs.num_envs
        self._hit = np.zeros(envs.num_envs, bool)

    @property
    def replaying(self) -> np.ndarray:
        """Which environments are in a replay [num_envs]."""
        return self._left >= 0

    def state(self) -> bytes:
        """What a checkpoint has to hold; padding makes most of it, so it is compressed."""
        future = {name: part for name, part in vars(self).items() if name[0] == "_"}
        return zlib.compress(pickle.dumps(future), 1)

    def restore(self, state: bytes) -> None:
        future = pickle.loads(zlib.decompress(state))
        if future.keys() != {name for name in vars(self) if name[0] == "_"}:
            raise ValueError("replayed collisions of another version of esc_gym")
        vars(self).update(future)

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
                self._crashes.append(Crash(ages[i], kept))
        self._hit = crashed & self.replaying
        self._left -= self.replaying
        return self._left == 0

    def begin(self, chosen: np.ndarray) -> np.ndarray:
        """Which of the episodes that have just begun, of ``chosen``, are replays [num_envs]."""
        for e in np.flatnonzero(chosen & self.replaying).tolist():
            crash = self._replayed[e]
            crash.danger += PACE * (self._hit[e] - crash.danger)
        self._left[chosen] = -1
        if not self._crashes or self._steps < self.waits:
            return chosen & self.replaying
        weights = np.array([crash.weight for crash in self._crashes])
        chances = weights / weights.sum()
        for e in np.flatnonzero(chosen).tolist():
            if self._generator.random() < self.share:
                crash = self._crashes[self._generator.choice(len(chances), p=chances)]
                self.envs.go_back([e], crash.kept)
                self._left[e], self._replayed[e] = crash.before + BEYOND, crash
        return chosen & self.replaying
