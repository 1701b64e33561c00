"""The figures of a comparison, drawn from its analysis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from esc_agents.compare.analysis import Task, duels, evaluated, overall_duels, row, transfer
from esc_agents.driving.rule_driver import RULE
from esc_agents.reporting import plots
from esc_agents.reporting.statistics import Estimate

WIDTH = 5.6  # inches: at 390 pixels, letters of 10 points are 10 pixels high


def curves(tasks: Sequence[Task]) -> Figure:
    """Return over training steps, a panel for each task; bands: 95 % over seeds.

    The baselines are not drawn: they drove other, and more, episodes.
    """
    figure, panels = _panels(len(tasks), 2.4)
    for axes, task in zip(panels, tasks, strict=True):
        for repr in task.reprs:
            runs = task.runs(repr)
            steps = evaluated(runs)
            returns = [np.mean(run.curve["results"][: len(steps)], axis=1) for run in runs]
            plots.band(axes, steps, returns, plots.color(repr), repr)
        axes.set_title(task.name, fontsize=10)
        axes.set_xlabel("labels" if task.imitated else "training steps")
        axes.xaxis.set_major_locator(MaxNLocator(4))
        axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:,.0f}k")
        plots.tidy(axes)
    figure.supylabel("return", fontsize=10)
    plots.legend(figure, panels)
    return figure


def regrets(tasks: Sequence[Task]) -> Figure:
    """Held-out regret over labels, a panel for each task; bands: 95 % over seeds. Dashed: of the
    action that is best on average."""
    figure, panels = _panels(len(tasks), 2.4)
    for axes, task in zip(panels, tasks, strict=True):
        for repr in task.reprs:
            runs = task.runs(repr)
            labels = evaluated(runs)
            found = [run.curve["regret"][: len(labels)] for run in runs]
            plots.band(axes, labels, found, plots.color(repr), repr)
        blind = task.runs(task.reprs[0])[0].curve["blind_regret"][-1]
        axes.axhline(blind, color=plots.GREY, linestyle="--", linewidth=1.2, label="one action")
        axes.set_xscale("log", base=2)
        axes.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        axes.set_ylim(bottom=0)
        axes.set_title(task.name, fontsize=10)
        axes.set_xlabel("labels")
        plots.tidy(axes)
    figure.supylabel("regret", fontsize=10)
    plots.legend(figure, panels)
    return figure


def bars(tasks: Sequence[Task]) -> Figure:
    """Return of the final policies: bars are means with 95 % intervals, dots are runs."""
    figure, panels = _panels(len(tasks), 2.6)
    for axes, task in zip(panels, tasks, strict=True):
        for place, repr in enumerate(task.reprs):
            mean = row(task, repr).mean
            axes.bar(place, mean.value, 0.7, color=plots.color(repr), alpha=0.75)
            _interval(axes, place, mean)
            scores = task.scores(repr)
            axes.plot([place] * len(scores), scores, "o", markersize=3, color="0.15", alpha=0.6)
        _limits(axes, task)
        axes.set_xticks(range(len(task.reprs)), task.reprs, fontsize=9, rotation=35, ha="right")
        axes.set_title(task.name, fontsize=10)
        plots.tidy(axes)
    figure.supylabel("return", fontsize=10)
    plots.legend(figure, panels)
    return figure


def improvement(tasks: Sequence[Task]) -> Figure:
    """Probability that a run of ours beats a rival's, a panel for each scenario and for all."""
    found = {task.name: {(d.ours, d.rival): d.better for d in duels(task)} for task in tasks}
    if len(tasks) > 1:
        found["mean of the scenarios"] = overall_duels(tasks)
    found = {name: pairs for name, pairs in found.items() if pairs}
    most = max(len({rival for _, rival in pairs}) for pairs in found.values())
    figure, panels = _panels(len(found), 0.9 + 0.28 * most)
    for axes, (name, pairs) in zip(panels, found.items(), strict=True):
        ours, rivals = (list(dict.fromkeys(names)) for names in zip(*pairs, strict=True))
        for (mine, rival), better in pairs.items():
            place = rivals.index(rival) + 0.3 * (ours.index(mine) - (len(ours) - 1) / 2)
            hue = plots.color(mine)
            axes.plot(
                [better.low, better.high],
                [place] * 2,
                color=hue,
                linewidth=4,
                alpha=0.35,
                solid_capstyle="butt",
            )
            axes.plot(better.value, place, "o", color=hue, markersize=5, clip_on=False, label=mine)
        axes.axvline(0.5, color=plots.GREY, linewidth=1, linestyle="--")
        axes.set_yticks(range(len(rivals)), [f"over {rival}" for rival in rivals], fontsize=9)
        axes.set_ylim(len(rivals) - 0.5, -0.5)
        axes.set_xlim(0, 1)
        axes.set_xlabel("probability of improvement", fontsize=9)
        axes.set_title(name, fontsize=10)
        plots.tidy(axes)
    plots.legend(figure, panels)
    return figure


def transfers(task: Task, reprs: Sequence[str]) -> Figure:
    """A matrix for each representation: traffic of training by traffic of driving."""
    tables = {repr: transfer(task, repr) for repr in reprs}
    values = [v for table in tables.values() for line in table.values() for v in line.values()]
    names = list(next(iter(tables.values()))["as it is"])
    figure, panels = _panels(len(reprs), 0.9 + 0.55 * len(names))
    for axes, (repr, table) in zip(panels, tables.items(), strict=True):
        grid = np.array([[line.get(name, np.nan) for name in names] for line in table.values()])
        axes.imshow(grid, cmap="viridis", vmin=min(values), vmax=max(values), aspect="auto")
        middle = (min(values) + max(values)) / 2
        for (y, x), value in np.ndenumerate(grid):
            color = "white" if value < middle else "black"
            axes.text(x, y, f"{value:.1f}", ha="center", va="center", color=color, fontsize=9)
        axes.set_xticks(range(len(names)), names, fontsize=8)
        axes.set_yticks(range(len(table)), list(table), fontsize=8)
        axes.set_title(repr, fontsize=10)
        axes.set_xlabel("driven in", fontsize=9)
    figure.supylabel("trained in", fontsize=9)
    return figure


def _limits(axes: Axes, task: Task) -> None:
    """Lines of the best blind policy and of IDM/MOBIL, if it drove."""
    marks = (RULE, task.baselines.rule, "-."), ("best blind policy", task.floor[1], ":")
    for label, summary, style in marks:
        if summary:
            axes.axhline(
                summary.reward, color=plots.GREY, linestyle=style, linewidth=1.2, label=label,
                zorder=0,
            )  # fmt: skip


def _interval(axes: Axes, x: float, estimate: Estimate) -> None:
    axes.plot([x, x], [estimate.low, estimate.high], color="0.1", linewidth=1.5)


def _panels(count: int, height: float) -> tuple[Figure, Sequence[Axes]]:
    """Panels of ``height`` inches, two beside each other: on a telephone they can still be read."""
    across = min(count, 2)
    down = -(-count // across)
    figure = Figure(figsize=(WIDTH, height * down + 0.4), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for spare in panels[count:]:
        spare.set_visible(False)
    return figure, list(panels[:count])
