"""The smallest comparison that still has everything, and results made by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from esc_agents.compare import store
from esc_agents.compare.grid import Cell, CompareConfig
from esc_agents.compare.store import Baselines, OrderEffect, Result
from esc_agents.driving.episodes import Episode, Summary
from tests.esc_agents.tiny import PPO, ROAD

ENV = "highway-fast-v0"
MORE = {"more": {"vehicles_count": 9}}


def small(**changes: Any) -> CompareConfig:
    """Two representations, two seeds, two candidates, two kinds of traffic, 32 steps."""
    values = {
        "env": (ENV,),
        "repr": ("esc", "fp"),
        "seeds": 2,
        "steps": 32,
        "episodes": 3,
        "tuning": {"steps": 32, "scales": (1.0, 0.1), "learning_rates": (1.0,)},
        "transfer": {ENV: MORE},
        "train": {
            "env_config": ROAD, "n_envs": 2, "encoder": {"hidden": (8,), "code_dim": 200},
            "ppo": PPO, "evaluation": {"episodes": 1},
            "observation": {"perception_distance": 200},
        },
        **changes,
    }  # fmt: skip
    return CompareConfig.model_validate(values)


def episode(reward: float, crashed: bool = False, seed: int = 0, ttc: float = 1.0) -> Episode:
    """A drive of 10 steps."""
    return Episode(seed, reward, 10, crashed, 20.0, 200.0, 0.0, 1, 5.0, ttc)


def result(
    repr: str, seed: int, rewards: list[float], shuffled: list[float] | None = None, **cell: Any
) -> Result:
    """A run whose final policy had these returns; it crashed where they are negative."""
    drives = [episode(reward, reward < 0, i) for i, reward in enumerate(rewards)]
    other = drives if shuffled is None else [episode(reward) for reward in shuffled]
    return Result(
        cell=Cell(**{"env": ENV, "algo": "ppo", "repr": repr, "seed": seed, **cell}),
        vehicles=20,
        slots=20 if repr in ("fp", "ap") else None,
        parameters=(1000, 2000),
        config=small().model_dump(mode="json")["train"] | {"ppo": {}, "encoder": {}},
        curve={"timesteps": [10, 20], "results": [rewards, rewards], "crashed": [[0], [0]]},
        drives={"": drives},
        shuffled=other,
        order=OrderEffect(10, 0.1 * (repr == "ap"), 1e-7),
        churn=0.25 if repr == "fp" else None,
        seconds=36.0,
        made_with={"esc-gym": "0", "commit": "abc"},
    )


def baselines(blind: float = 0.0, rule: float = 10.0) -> Baselines:
    """A blind policy and IDM/MOBIL with these returns, give or take 1."""

    def summary(mean: float) -> Summary:
        return Summary.of([episode(mean - 1), episode(mean), episode(mean + 1)])

    names = {"always IDLE": summary(blind), "random": summary(blind - 5)}
    return Baselines(names, summary(rule), {"esc-gym": "0"})


class HereEngine:
    """Runs jobs one after the other in this process, and remembers their names."""

    def __init__(self) -> None:
        self.names: list[str] = []

    def run(self, jobs: Any, out: Any, done: Any, post: Any) -> None:
        for job in jobs:
            self.names.append(job.name)
            error = None
            try:
                job.do(out, post)
            except Exception as raised:
                error = raised
            done(job, error)


def measured(out: Any) -> dict[str, Any]:
    """What a comparison found, without what differs between two that are equal."""
    found: dict[str, Any] = {}
    for folder in store.task_folders(out):
        for run in store.results(folder):
            found[run.cell.name] = replace(run, seconds=0.0, made_with={})
        for tuned in store.tuned(folder):
            found[f"tuning {tuned.cell.name}"] = tuned.returns
        baselines = store.baselines(folder)
        found[folder.name] = baselines and (baselines.blind, baselines.rule)
    return found
