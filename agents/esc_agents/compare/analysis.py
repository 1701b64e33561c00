"""What finished runs say: tables of numbers, which the report prints and the CSV files hold."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from esc_agents.compare import store
from esc_agents.compare.grid import IMITATION, Candidate
from esc_agents.compare.store import Baselines, Result, Tuned
from esc_agents.driving.episodes import MEANS, Episode, Summary
from esc_agents.driving.experts import PLANNER
from esc_agents.driving.rule_driver import RULE
from esc_agents.reporting.statistics import (
    Estimate,
    difference_of_means,
    interquartile_mean,
    mean_of_runs,
    probability_of_improvement,
    wilson_interval,
)
from esc_gym.encoders import REPRESENTATIONS

OURS = ("esc", "esc-exp")


@dataclass(frozen=True)
class Task:
    """All that is known of a scenario and algorithm."""

    folder: Path
    settings: dict[str, Any]
    baselines: Baselines
    results: list[Result]
    tuned: list[Tuned]

    @property
    def name(self) -> str:
        way = self.settings["algo"]
        return f"{self.settings['env']}, {way if way == IMITATION else way.upper()}"

    @cached_property
    def reprs(self) -> list[str]:
        """The representations, in the package's order."""
        known = list(REPRESENTATIONS)
        found = {result.cell.repr for result in self.results if not result.cell.traffic}
        return sorted(found, key=lambda r: (known.index(r) if r in known else len(known), r))

    @property
    def pairs(self) -> list[tuple[str, str]]:
        """(one of ours, another), each pair once."""
        return [
            (ours, rival)
            for ours in OURS
            for rival in self.reprs
            if ours in self.reprs and rival not in OURS[: OURS.index(ours) + 1]
        ]

    def runs(self, repr: str, traffic: str = "") -> list[Result]:
        """Its runs, by seed."""
        found = [r for r in self.results if (r.cell.repr, r.cell.traffic) == (repr, traffic)]
        return sorted(found, key=lambda result: result.cell.seed)

    def scores(self, repr: str) -> list[float]:
        """Mean return of each run's final policy."""
        return [mean_return(result.drives[""]) for result in self.runs(repr)]

    @property
    def imitated(self) -> bool:
        """Whether its runs learned from labels."""
        return self.settings["algo"] == IMITATION

    @property
    def in_portions(self) -> bool:
        """Whether they did so anew from growing portions of them, the same for all."""
        return self.imitated and self.settings["imitate"].get("portions", 1) > 1

    @property
    def floor(self) -> tuple[str, Summary]:
        """The blind policy of highest mean return."""
        return max(self.baselines.blind.items(), key=lambda item: item[1].reward)

    @property
    def reach(self) -> float:
        """The upper end of all blind policies' intervals."""
        return max(summary.reward_high for summary in self.baselines.blind.values())

    def normal(self, repr: str) -> list[float] | None:
        """Scores: 0 is the best blind policy and 1 is IDM/MOBIL; None where that is not more."""
        low, rule = self.floor[1].reward, self.baselines.rule
        if rule is None or rule.reward <= low:
            return None
        return [(score - low) / (rule.reward - low) for score in self.scores(repr)]


@dataclass(frozen=True)
class Row:
    """A representation's final policies in a scenario. collisions: of all runs' episodes."""

    runs: int
    mean: Estimate
    middle: Estimate
    collisions: Estimate
    means: dict[str, float]
    min_ttc: float


@dataclass(frozen=True)
class Duel:
    """One against a rival. difference: of mean returns; better: probability of improvement."""

    ours: str
    rival: str
    difference: Estimate
    better: Estimate

    @property
    def verdict(self) -> str:
        """wins, ties or loses: by whether the interval of the difference holds 0."""
        if self.difference.low == self.difference.high:
            return "has too few runs to tell"
        if self.difference.low > 0:
            return "wins"
        return "loses" if self.difference.high < 0 else "ties"


def load(out: Path, trust: bool = False) -> list[Task]:
    """Everything in a comparison's directory that has both runs and baselines."""
    tasks = []
    for folder in store.task_folders(out):
        baselines, results = store.baselines(folder, trust), store.results(folder, trust)
        if baselines and any(not result.cell.traffic for result in results):
            settings, tuned = store.task_settings(folder, trust), store.tuned(folder, trust)
            tasks.append(Task(folder, settings, baselines, results, tuned))
    return tasks


def evaluated(runs: Sequence[Result]) -> list[float]:
    """After how many steps, or labels, all runs were judged on the way."""
    count = min(len(run.curve["timesteps"]) for run in runs)
    return np.mean([run.curve["timesteps"][:count] for run in runs], axis=0).tolist()


def tuning_scores(
    tuned: Sequence[Tuned], repr: str, tried: Sequence[Candidate]
) -> dict[Candidate, float]:
    """Mean return of a representation's tuning runs, by candidate; those without runs left out."""
    returns: dict[Candidate, list[float]] = {candidate: [] for candidate in tried}
    for run in tuned:
        if run.cell.repr == repr:
            returns[run.cell.candidate] += run.returns
    return {candidate: float(np.mean(found)) for candidate, found in returns.items() if found}


def mean_return(episodes: Sequence[Episode]) -> float:
    return float(np.mean([episode.reward for episode in episodes]))


def row(task: Task, repr: str) -> Row:
    """The numbers of a representation in a scenario."""
    runs, scores = task.runs(repr), task.scores(repr)
    episodes = list(chain.from_iterable(run.drives[""] for run in runs))
    crashes = sum(episode.crashed for episode in episodes)
    return Row(
        len(runs),
        mean_of_runs([scores]),
        interquartile_mean([scores]),
        Estimate(crashes / len(episodes), *wilson_interval(crashes, len(episodes))),
        {name: float(np.mean([getattr(e, name) for e in episodes])) for name in MEANS},
        float(np.median([episode.min_ttc for episode in episodes])),
    )


def duels(task: Task) -> list[Duel]:
    """ESC, and ESC of exponentials, against each rival in a scenario."""
    return [
        Duel(
            ours,
            rival,
            difference_of_means(task.scores(ours), task.scores(rival)),
            probability_of_improvement([task.scores(ours)], [task.scores(rival)]),
        )
        for ours, rival in task.pairs
    ]


def overall(tasks: Sequence[Task]) -> dict[str, Estimate]:
    """IQM of normalised scores over all scenarios, of representations that ran in all of them."""
    usable = [task for task in tasks if task.normal(task.reprs[0]) is not None]
    found = {}
    for repr in dict.fromkeys(chain.from_iterable(task.reprs for task in usable)):
        if all(repr in task.reprs for task in usable):
            found[repr] = interquartile_mean([task.normal(repr) or [] for task in usable])
    return found


def overall_duels(tasks: Sequence[Task]) -> dict[tuple[str, str], Estimate]:
    """Probability that one improves on a rival, mean over the scenarios that both ran in."""
    found = {}
    for ours, rival in dict.fromkeys(chain.from_iterable(task.pairs for task in tasks)):
        both = [task for task in tasks if (ours, rival) in task.pairs]
        found[ours, rival] = probability_of_improvement(
            [task.scores(ours) for task in both], [task.scores(rival) for task in both]
        )
    return found


def above_floor(task: Task, repr: str) -> bool:
    """Does the interval of its mean return lie above those of all blind policies?"""
    return mean_of_runs([task.scores(repr)]).low > task.reach


@dataclass(frozen=True)
class Shuffle:
    """What random order at test time does: returns with and without, change by run; decisions."""

    plain: float
    shuffled: float
    change: Estimate
    decisions: int
    changed: float
    features: float


def shuffle(task: Task, repr: str) -> Shuffle:
    """Robustness of a representation's policies to the order of the vehicles."""
    runs = task.runs(repr)
    plain, other = task.scores(repr), [mean_return(run.shuffled) for run in runs]
    decisions = sum(run.order.decisions for run in runs)
    changed = sum(run.order.changed * run.order.decisions for run in runs)
    return Shuffle(
        float(np.mean(plain)),
        float(np.mean(other)),
        mean_of_runs([[after - before for before, after in zip(plain, other, strict=True)]]),
        decisions,
        changed / max(decisions, 1),
        max(run.order.features for run in runs),
    )


def transfer(task: Task, repr: str) -> dict[str, dict[str, float]]:
    """Mean returns by traffic of training, then traffic of driving; "as it is": the scenario's."""
    table: dict[str, dict[str, float]] = {}
    for trained in ["", *task.settings["transfer"]]:
        runs = task.runs(repr, trained)
        if not runs:
            continue
        own = trained or "as it is"
        names = {own: "", **{name: name for name in runs[0].drives if name}}
        table[own] = {
            name: float(np.mean([mean_return(run.drives[key]) for run in runs]))
            for name, key in names.items()
        }
    return table


def summary_rows(tasks: Sequence[Task]) -> Iterator[dict[str, Any]]:
    """summary.csv: a line for each representation and each driver that learns nothing."""
    for task in tasks:
        first = {"scenario": task.settings["env"], "algo": task.settings["algo"]}
        for repr in task.reprs:
            found = row(task, repr)
            numbers = {
                **_columns("return", found.mean), **_columns("iqm", found.middle),
                **_columns("collisions", found.collisions), **found.means,
                "min_ttc": found.min_ttc,
            }  # fmt: skip
            yield {**first, "driver": repr, "runs": found.runs, **numbers}
        for name, s in drivers(task).items():
            mean = Estimate(s.reward, s.reward_low, s.reward_high)
            crash = Estimate(s.collision_rate, s.collision_low, s.collision_high)
            numbers = {**_columns("return", mean), **_columns("collisions", crash)}
            numbers |= {name: getattr(s, name) for name in (*MEANS, "min_ttc")}
            yield {**first, "driver": name, "runs": "", **numbers}


def run_rows(tasks: Sequence[Task]) -> Iterator[dict[str, Any]]:
    """runs.csv: a line for each run and traffic that its policy drove in."""
    for task in tasks:
        for result in sorted(
            task.results, key=lambda r: (r.cell.repr, r.cell.traffic, r.cell.seed)
        ):
            cell, both = result.cell, {**result.drives, "shuffled": result.shuffled}
            for driven, episodes in both.items():
                s = Summary.of(episodes)
                yield {
                    "scenario": cell.env, "algo": cell.algo, "repr": cell.repr, "seed": cell.seed,
                    "trained_in": cell.traffic, "driven_in": driven, "episodes": s.episodes,
                    "return": s.reward, "collisions": s.collision_rate,
                    **{name: getattr(s, name) for name in (*MEANS, "min_ttc")},
                }  # fmt: skip


def drivers(task: Task) -> dict[str, Summary]:
    """Drivers that learn nothing, the planner and IDM/MOBIL first if they drove."""
    first = {PLANNER: task.baselines.planner, RULE: task.baselines.rule}
    return {name: drove for name, drove in first.items() if drove} | task.baselines.blind


def missing(task: Task) -> list[str]:
    """A sentence for each driver that is not there."""
    return [
        f"{name} is missing: {why.rstrip('.')}." for name, why in task.baselines.missing.items()
    ]


def _columns(name: str, estimate: Estimate) -> dict[str, float]:
    return {name: estimate.value, f"{name}_low": estimate.low, f"{name}_high": estimate.high}
