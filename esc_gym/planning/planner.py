"""What all planners share: how far they look, and what they know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from esc_gym.planning.guesses import guess
from esc_gym.planning.rollouts import OWN, Policy, best, meta_actions, rollouts
from esc_gym.vector.arguments import indices_of
from esc_gym.vector.environment import SetVectorEnv

Knowledge = Literal["all", "observed"]


@dataclass(frozen=True, kw_only=True)
class Planner:
    """Base of planners.

    horizon: policy steps looked ahead. discount: gamma, of the rewards. crash_cost: what a
    collision costs beyond what the scenario takes for it: where that is little, the best plan often
    ends in a crash.

    knows: "all", or only what is "observed"; then in ``futures`` guesses of the rest, over which
    returns are averaged. seed: of what is drawn at random, which depends on it, and on an
    environment's own seed and time, and on nothing else.

    Raises ValueError for a number out of its range, or another kind of knowledge.
    """

    horizon: int = 10
    discount: float = 0.95
    crash_cost: float = 10.0
    knows: Knowledge = "all"
    futures: int = 4
    seed: int = 0

    def __post_init__(self) -> None:
        self._at_least_1("horizon", "futures")
        if self.knows not in get_args(Knowledge):
            expected = " or ".join(map(repr, get_args(Knowledge)))
            raise ValueError(f"knows: expected {expected}, got {self.knows!r}")
        if not 0.0 <= self.discount <= 1.0:
            raise ValueError(f"discount: expected a number from 0 to 1, got {self.discount}")

    def _at_least_1(self, *names: str) -> None:
        for name in names:
            if (number := getattr(self, name)) < 1:
                raise ValueError(f"{name}: expected at least 1, got {number}")

    def check(self, envs: SetVectorEnv) -> None:
        """Raises ValueError where there is nothing in ``envs`` to plan with this."""
        raise NotImplementedError

    def actions(self, envs: SetVectorEnv) -> NDArray:
        """What to do in each environment, which is left as it is: [num_envs, ...]."""
        raise NotImplementedError


class Scenes:
    """Environments as a planner knows them: several copies of each, where it has to guess.

    indices: of the environments; None: all. ``places`` [K]: where the K of them are in ``envs``.
    """

    def __init__(
        self, planner: Planner, envs: SetVectorEnv, indices: Sequence[int] | NDArray | None
    ) -> None:
        self.planner, self.envs = planner, envs
        everyone = range(envs.num_envs) if indices is None else indices
        self.places = np.array(indices_of(everyone, envs.num_envs))
        self.copies = self.places[:, None]
        if planner.knows == "observed":
            self.envs = guess(envs, self.places, planner.futures, planner.seed)
            self.copies = np.arange(self.envs.num_envs).reshape(-1, planner.futures)

    def returns(self, which: Any, plans: NDArray, policy: Policy | None = None) -> NDArray:
        """What plans are worth, on average over the copies of a scene: [k, P].

        which [k]: of the K scenes. plans [k, P, horizon, ...]. policy: as of ``rollouts``.
        """
        copies = self.copies[which]
        actions = np.repeat(plans[:, None], copies.shape[1], axis=1)
        found = rollouts(
            self.envs, np.repeat(copies, plans.shape[1]), actions.reshape(-1, *plans.shape[2:]),
            self.planner.discount, self.planner.crash_cost, policy,
        )  # fmt: skip
        return found.reshape(*copies.shape, -1).mean(axis=1)


@dataclass(frozen=True, kw_only=True)
class MetaPlanner(Planner):
    """Base of planners of meta-actions: they try some steps, and then go on in a few ways.

    continuations: names of meta-actions, of which each is tried from then on; None: all that there
    are. policy: a driver of whom it is tried, too, that he goes on as he would: {observations of K
    environments: actions [K]}.
    """

    continuations: tuple[str, ...] | None = ("IDLE", "SLOWER")
    policy: Policy | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.continuations == () and self.policy is None:
            raise ValueError("continuations: expected at least one name of a meta-action, got none")

    def check(self, envs: SetVectorEnv) -> None:
        """Raises ValueError where there are no meta-actions, or none of a continuation's name."""
        self.ways_on(envs)

    def ways_on(self, envs: SetVectorEnv) -> list[int]:
        """Numbers of the continuations; OWN stands for what ``policy`` does. Raises as above."""
        numbers = meta_actions(envs)
        names = tuple(numbers) if self.continuations is None else self.continuations
        if unknown := [name for name in names if name not in numbers]:
            raise ValueError(f"continuations: expected {', '.join(numbers)}, got {unknown[0]!r}")
        return [*(numbers[name] for name in names), *([OWN] if self.policy else [])]

    def values(self, envs: SetVectorEnv, indices: Sequence[int] | NDArray | None = None) -> NDArray:
        """Discounted return of each action within the horizon: [num_envs or len(indices), A].

        0 where an episode has ended. ``envs`` is left as it is. Raises ValueError where the batch
        engine does not simulate it (``envs.report()``).
        """
        raise NotImplementedError

    def actions(self, envs: SetVectorEnv) -> NDArray[np.int64]:
        """The best action of each environment; of equally good ones IDLE, else the first."""
        return best(self.values(envs), meta_actions(envs))
