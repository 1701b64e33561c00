"""Finished runs of one scenario, seed by seed, beside the policies that never look."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from esc_agents import files
from esc_agents.config import TrainConfig, scenario_name
from esc_agents.driving.baselines import best_blind, is_above
from esc_agents.driving.episodes import Summary, return_of, summaries, table
from esc_agents.driving.experts import PLANNER
from esc_agents.driving.rule_driver import RULE
from esc_agents.errors import UserError, say
from esc_agents.reporting.statistics import mean_interval
from esc_agents.reporting.tables import markdown
from esc_agents.training import run_directory
from esc_agents.training.run_directory import read_evaluations

OWN = {"seed", "run_dir", "device", "threads", "vec", "checkpoint_every"}
"""Fields in which runs of one scenario may differ."""


@dataclass(frozen=True)
class Run:
    """A finished run.

    trained, blind, rule: results on the evaluation's episodes, blind ones by policy, of IDM/MOBIL
    if it drove. curve: training steps [k] and returns [k, episodes] of the evaluations on the way.
    metrics: rows of metrics.csv.
    """

    path: Path
    config: TrainConfig
    commands: tuple[str, ...]
    versions: dict[str, str]
    trained: Summary
    blind: dict[str, Summary]
    rule: Summary | None
    curve: tuple[NDArray, NDArray]
    metrics: list[dict[str, str]]

    @classmethod
    def read(cls, path: Path, trust: bool = False) -> Run:
        """Raises UserError where ``path`` holds no finished run."""
        config = run_directory.open_run(path, trust)
        if not run_directory.finished(path):
            raise UserError(
                f"{path} is no finished run: expected results.json and SHA256SUMS in it; finish "
                f"it with {run_directory.resumed_by(path)}"
            )
        run_directory.verify(
            path, "results.json", "evaluations.npz", "metrics.csv", "versions.json"
        )
        try:
            results = summaries(json.loads((path / "results.json").read_text(encoding="utf-8")))
            saved = read_evaluations(path / "evaluations.npz")
            curve = saved["timesteps"], saved["results"]
            with (path / "metrics.csv").open(newline="", encoding="utf-8") as file:
                metrics = list(csv.DictReader(file))
            versions = json.loads((path / "versions.json").read_text(encoding="utf-8"))
            commands = (path / "command.txt").read_text(encoding="utf-8").splitlines()
            trained, rule = results.pop(config.repr), results.pop(RULE, None)
            results.pop(PLANNER, None)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path} is damaged: {type(error).__name__}: {error}") from error
        return cls(path, config, tuple(commands), versions, trained, results, rule, curve, metrics)

    @property
    def best_blind(self) -> str:
        """The blind policy whose interval reaches highest."""
        return best_blind(self.blind)

    @property
    def above(self) -> bool:
        """Whether the trained interval lies above that of every blind policy."""
        return is_above(self.trained, self.blind)


def write_report(paths: Sequence[Path], out: Path, trust: bool = False) -> None:
    """Read finished runs, one for each seed, and write ``out``, a figure and a table beside it."""
    runs = sorted((Run.read(path, trust) for path in paths), key=lambda r: r.config.seed)
    check_alike(runs)
    out.parent.mkdir(parents=True, exist_ok=True)
    figure = draw(runs)
    files.write_atomically(
        out.with_suffix(".png"), lambda file: figure.savefig(file, format="png", dpi=150)
    )
    files.write_text(out.with_suffix(".csv"), metrics_table(runs))
    files.write_text(out, text(runs, paths, out) + "\n")
    say(verdict(runs))
    say(f"Written: {', '.join(str(out.with_suffix(end)) for end in ('.md', '.png', '.csv'))}")


def check_alike(runs: Sequence[Run]) -> None:
    """Raises UserError unless the runs differ in their seeds and nothing that matters."""
    seeds = [r.config.seed for r in runs]
    if len(set(seeds)) < len(seeds):
        raise UserError(f"runs: expected a different seed each, got {seeds}")
    first = runs[0]
    values = first.config.model_dump(exclude=OWN)
    for other in runs[1:]:
        theirs = other.config.model_dump(exclude=OWN)
        if differing := [key for key in values if values[key] != theirs[key]]:
            raise UserError(
                f"runs: expected one scenario with the same settings, but {first.path} and "
                f"{other.path} differ in {', '.join(differing)}"
            )
        if other.blind != first.blind:
            raise UserError(
                f"runs: the blind policies of {first.path} and {other.path} differ, so their "
                "environments do; train both with the same version"
            )


def verdict(runs: Sequence[Run]) -> str:
    """One plain sentence: above every blind baseline, or not."""
    name, above = runs[0].config.repr, [r for r in runs if r.above]
    if len(above) == len(runs):
        return (
            f"Above every blind baseline: in all {len(runs)} runs the 95 % interval of the return "
            f"of {name} lies above those of all blind policies."
        )
    rest = [r for r in runs if not r.above]
    cases = "; ".join(
        f"seed {r.config.seed}: {return_of(r.trained)} beside {return_of(r.blind[r.best_blind])} "
        f"of {r.best_blind}"
        for r in rest
    )
    return (
        f"Not above every blind baseline: the 95 % intervals of the return lie apart in "
        f"{len(above)} of {len(runs)} runs ({cases})."
    )


def collisions(runs: Sequence[Run]) -> str:
    """What the return alone does not say: who crashes how often."""
    rates = [f"{r.trained.collision_rate:.0%} (seed {r.config.seed})" for r in runs]
    name, safest = min(runs[0].blind.items(), key=lambda item: item[1].collision_rate)
    return (
        f"Episodes that end in a collision: {', '.join(rates)}; fewest among the blind policies: "
        f"{safest.collision_rate:.0%} ({name})."
    )


def text(runs: Sequence[Run], paths: Sequence[Path], out: Path) -> str:
    """The Markdown page."""
    config = runs[0].config
    episodes = runs[0].trained.episodes
    rows = {f"{config.repr}, seed {r.config.seed}": r.trained for r in runs} | runs[0].blind
    if rule := next((r.rule for r in runs if r.rule), None):  # runs made before have none
        rows[RULE] = rule
    seeds = ", ".join(str(r.config.seed) for r in runs)
    return "\n".join(
        [
            f"# Learning: {scenario_name(config)}",
            "",
            verdict(runs),
            collisions(runs),
            "",
            f"{config.algo.upper()} with `{config.repr}` on {config.env}, {config.steps:,} steps, "
            f"seeds {seeds}; {_versions(runs)}. Written by `python -m esc_agents.cli.learning "
            f"--runs {' '.join(map(str, paths))} --out {out}` from the runs of",
            "",
            "```",
            *(_without_run_dir(line) for r in runs for line in r.commands),
            "```",
            "",
            f"Every policy drove the same {episodes} episodes (seeds from "
            f"{config.evaluation.seed} on, which training never sees); brackets hold 95 % "
            "intervals over these episodes.",
            "",
            markdown(table(rows)),
            "",
            f"![Return over training steps, by seed, and of the blind policies]"
            f"({out.with_suffix('.png').name})",
            "",
            "Return on these episodes during training; bands are 95 % intervals. What each run "
            f"logged: [{out.with_suffix('.csv').name}]({out.with_suffix('.csv').name}).",
        ]
    )


def _without_run_dir(command: str) -> str:
    """Where somebody kept a run says nothing about it."""
    return re.sub(r" --run-dir[ =]\S+", "", command)


def _versions(runs: Sequence[Run]) -> str:
    """Versions, device and commit, several where the runs' differ."""
    names = dict.fromkeys(name for r in runs for name in r.versions)
    found = {name: dict.fromkeys(r.versions.get(name, "unknown") for r in runs) for name in names}
    return ", ".join(f"{name} {' and '.join(values)}" for name, values in found.items())


def metrics_table(runs: Sequence[Run]) -> str:
    """metrics.csv of every run, the seed in front, numbers to six digits."""
    columns = dict.fromkeys(key for r in runs for row in r.metrics for key in row)
    table = io.StringIO()
    writer = csv.writer(table, lineterminator="\n")
    writer.writerow(["seed", *columns])
    for r in runs:
        for row in r.metrics:
            writer.writerow([r.config.seed, *(_short(row.get(key) or "") for key in columns)])
    return table.getvalue()


def _short(value: str) -> str:
    return value if not value or value.isdigit() else f"{float(value):.6g}"


def draw(runs: Sequence[Run]) -> Figure:
    """Evaluation return of every seed over training steps, the blind policies as lines."""
    figure = Figure(figsize=(9, 5), layout="constrained")
    axes: Axes = figure.subplots()
    for r in runs:
        steps, returns = r.curve
        before = steps < r.config.steps  # at the end stands the model that the run ended with
        intervals = [mean_interval(row) for row in returns[before]]
        end = (r.trained.reward, r.trained.reward_low, r.trained.reward_high)
        mean, low, high = np.array([*intervals, end]).T
        x = np.append(steps[before], r.config.steps)
        (line,) = axes.plot(x, mean, marker="o", markersize=4, label=f"seed {r.config.seed}")
        axes.fill_between(x, low, high, color=line.get_color(), alpha=0.12, linewidth=0)
    _blind_lines(axes, runs[0].blind)
    config = runs[0].config
    axes.set_title(f"{scenario_name(config)}: {config.repr}, {config.algo.upper()}")
    axes.set_xlabel("training steps")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
    axes.set_ylabel(f"return, mean of {runs[0].trained.episodes} episodes")
    axes.legend(frameon=False, loc="upper left")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def _blind_lines(axes: Axes, blind: Mapping[str, Summary]) -> None:
    """A line and a band each, labelled at the right edge, where the labels are kept apart."""
    low, high = axes.get_ylim()
    values = [v for s in blind.values() for v in (s.reward_low, s.reward_high)]
    low, high = min(low, *values), max(high, *values)
    margin = 0.03 * (high - low)
    axes.set_ylim(low - margin, high + margin)
    place = -inf
    for name, summary in sorted(blind.items(), key=lambda item: item[1].reward):
        axes.axhspan(summary.reward_low, summary.reward_high, color="0.4", alpha=0.07, linewidth=0)
        axes.axhline(summary.reward, color="0.4", linestyle="--", linewidth=1)
        place = max(summary.reward, place + 1.6 * margin)
        axes.annotate(
            name, (1.0, summary.reward), (1.03, place), xycoords=axes.get_yaxis_transform(),
            textcoords=axes.get_yaxis_transform(), fontsize=8, va="center", color="0.25",
            arrowprops={
                "arrowstyle": "-", "color": "0.6", "linewidth": 0.6, "shrinkA": 0, "shrinkB": 0,
                "relpos": (0, 0.5),
            },
        )  # fmt: skip
