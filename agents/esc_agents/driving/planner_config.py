"""How a planner is to look ahead, as YAML and the command line say it."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, ValidationInfo, field_validator
from pydantic_core import PydanticCustomError

from esc_agents.config import Model, Probability, Seed, Size

Method = Literal["look-ahead", "tree", "cross-entropy"]


class PlannerConfig(Model):
    """How far, and with what knowledge, a planner looks ahead (esc_gym.planning). What is not given
    is as the method has it; what a method does not have is an error."""

    method: Method | None = None
    """look-ahead: all that can be done in the first steps; tree: what is promising, farther;
    cross-entropy: of continuous actions. Default: cross-entropy for those, else look-ahead."""
    knows: Literal["all", "observed"] = "all"
    """all: what the others want, and what is still to be drawn; observed: what can be seen."""
    horizon: Size | None = None
    """Policy steps looked ahead; default 10, of continuous actions 20."""
    discount: Probability | None = None
    """Default 0.95."""
    crash_cost: NonNegativeFloat | None = None
    """What a collision costs beyond what the scenario takes for it; default 10."""
    continuations: tuple[str, ...] | None = None
    """Meta-actions of which each is tried to the horizon; default IDLE SLOWER; all: every one."""
    policy: str | None = None
    """A run directory, or zoo:NAME: that it drives on is tried, too."""
    free: Annotated[int, Field(gt=0, le=8)] | None = None
    """Of look-ahead: in how many steps, from the first on, every action is tried; default 2, where
    it is to be imitated 1."""
    expansions: Size | None = None
    """Of tree: how many sequences are followed by every action; default 10."""
    milliseconds: NonNegativeFloat | None = None
    """Of tree: after which no sequence is followed any more; default: no limit."""
    samples: Annotated[Size, Field(ge=8)] | None = None
    """Of cross-entropy: sequences in an iteration; default 64."""
    iterations: Size | None = None
    """Of cross-entropy; default 4."""
    futures: Size | None = None
    """Guesses of what cannot be seen, over which is averaged; default 4."""
    seed: Seed = 0
    """Of the guesses, and of what is drawn at random."""

    @field_validator("futures")
    @classmethod
    def _guessed(cls, futures: int | None, info: ValidationInfo) -> int | None:
        if futures is not None and info.data.get("knows") == "all":
            raise PydanticCustomError(
                "knows", "needs knows: observed, as nothing is guessed by what knows all"
            )
        return futures
