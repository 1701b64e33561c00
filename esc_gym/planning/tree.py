"""Tree search: look farther where it is promising."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from math import log, sqrt
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from esc_gym.planning.planner import MetaPlanner, Scenes
from esc_gym.planning.rollouts import meta_actions
from esc_gym.vector.environment import SetVectorEnv

Plan = tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class TreeSearch(MetaPlanner):
    """Open-loop UCT (Kocsis and Szepesvari, 2006; open-loop as Bubeck and Munos, 2010).

    A node is a sequence of actions. The most promising one that is not expanded yet is followed by
    every action, and from there by each continuation to the horizon: the first expansion is
    ``LookAhead(free=1)``. What a sequence is worth is the best of what begins with it: where it is
    known what comes, or averaged over guesses, a plan has one return, and not a distribution.

    expansions: how many, each of A * C rollouts in every scene. milliseconds: after which none is
    begun; what is found then depends on the machine. exploration: c of UCB1, with returns between
    the lowest and the highest found as 0 and 1.

    Raises ValueError for expansions below 1, or a negative number of the others.
    """

    expansions: int = 10
    exploration: float = 0.3
    milliseconds: float | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        self._at_least_1("expansions")
        for name in ("exploration", "milliseconds"):
            if (number := getattr(self, name)) is not None and number < 0:
                raise ValueError(f"{name}: expected at least 0, got {number}")

    def values(self, envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None) -> NDArray:
        begun = perf_counter()
        count, after = len(meta_actions(envs)), self.ways_on(envs)
        scenes = Scenes(self, envs, indices)
        trees = [Tree(count, self.horizon, self.exploration) for _ in scenes.places]
        for number in range(self.expansions):
            late = self.milliseconds is not None and (
                perf_counter() - begun > self.milliseconds / 1000
            )
            open_trees = [i for i, tree in enumerate(trees) if () not in tree.closed]
            if not open_trees or (number and late):
                break
            leaves = [trees[i].leaf() for i in open_trees]
            plans = np.array([_plans(leaf, count, after, self.horizon) for leaf in leaves])
            returns = scenes.returns(open_trees, plans, self.policy)
            found = returns.reshape(len(leaves), count, -1).max(axis=2)
            for i, leaf, values in zip(open_trees, leaves, found.tolist(), strict=True):
                trees[i].expand(leaf, values)
        return np.array([tree.values() for tree in trees])


def _plans(leaf: Plan, count: int, after: list[int], horizon: int) -> list[list[int]]:
    """The leaf's actions, then any, then a continuation: [count * len(after), horizon]."""
    left = horizon - len(leaf) - 1
    return [[*leaf, action, *[way] * left] for action in range(count) for way in after]


class Tree:
    """Sequences of ``count`` actions, up to a length of ``horizon``.

    best: what the best plan is worth that begins with a sequence. visits: how many expansions there
    were at it or below. closed: those from which on everything is tried.
    """

    def __init__(self, count: int, horizon: int, exploration: float) -> None:
        self.count, self.horizon, self.exploration = count, horizon, exploration
        self.best: dict[Plan, float] = {}
        self.visits: Counter[Plan] = Counter()
        self.closed: set[Plan] = set()

    def leaf(self) -> Plan:
        """The sequence to expand next: at each node on by UCB1, of equally good ones the first."""
        found = self.best.values()
        low, unit = min(found, default=0.0), (max(found, default=0.0) - min(found, default=0.0))
        at: Plan = ()
        while self.visits[at]:
            tries = log(self.visits[at])

            def score(sequence: Plan, tries: float = tries) -> float:
                worth = (self.best[sequence] - low) / (unit or 1.0)
                return worth + self.exploration * sqrt(tries / (1 + self.visits[sequence]))

            at = max((one for one in self._after(at) if one not in self.closed), key=score)
        return at

    def expand(self, leaf: Plan, values: list[float]) -> None:
        """Note what the actions after ``leaf`` are worth."""
        self.best |= zip(self._after(leaf), values, strict=True)
        if len(leaf) + 1 == self.horizon:
            self.closed.update(self._after(leaf))
        for length in range(len(leaf), -1, -1):
            at = leaf[:length]
            self.visits[at] += 1
            self.best[at] = max(self.best.get(at, values[0]), *values)
            if self.closed.issuperset(self._after(at)):
                self.closed.add(at)

    def values(self) -> list[float]:
        """Of the first actions."""
        return [self.best[one] for one in self._after(())]

    def _after(self, at: Plan) -> list[Plan]:
        return [(*at, action) for action in range(self.count)]
