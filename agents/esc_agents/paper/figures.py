"""The figures of the paper's experiment, drawn from finished cells."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter, StrMethodFormatter

from esc_agents.paper.cells import TEST_SIZES, overtaking
from esc_agents.paper.results import Result
from esc_agents.paper.samples import Samples
from esc_agents.paper.side_by_side import (
    Column,
    Table,
    column_of,
    columns_of,
    of_the_table,
    published,
    title_of,
)
from esc_agents.paper.targets import MAX_VEHICLES, TARGETS, VEHICLE_DIM
from esc_agents.reporting import plots
from esc_gym.theory import required_code_dim

COLORS: dict[Column, str] = {
    ("esc", "any"): "#56b4e9",
    **{(name, "fixed"): color for name, color in plots.COLORS.items()},
}
SIZES_COLORS = dict(zip(TEST_SIZES, ("#a6cee3", "#56b4e9", "#0072b2", "#003a5d"), strict=True))


def curves(results: Sequence[Result], benchmark: int) -> Figure:
    """Error over updates, a panel for each size of the test sets; bands: 95 % over seeds."""
    found = [r for r in of_the_table(results) if r.cell.benchmark == benchmark]
    sizes = sorted({size for r in found for size in r.points[-1].errors} & set(TEST_SIZES))
    figure = Figure(figsize=(2.9 * len(sizes) + 1, 3.3), layout="constrained")
    panels = figure.subplots(1, len(sizes), sharey=True, squeeze=False)[0]
    for axes, size in zip(panels, sizes, strict=True):
        for column in _columns(found):
            runs = [r for r in found if column_of(r.cell) == column and size in r.points[-1].errors]
            if not runs:
                continue
            updates = [point.update for point in runs[0].points]
            errors = [[p.errors[size] for p in r.points] for r in runs]
            plots.band(axes, updates, errors, _color(column), title_of(column))
            if theirs := published().get((benchmark, size, *column)):
                axes.plot(
                    updates[-1], theirs.mean, "D", markersize=5, markerfacecolor="none",
                    color=_color(column), clip_on=False, zorder=3,
                )  # fmt: skip
        axes.set_title(f"M = {size}", fontsize=10)
        axes.set_xlabel("updates")
        _log_scale(axes)
        plots.tidy(axes)
    panels[0].set_ylabel("mean squared error")
    figure.suptitle(f"Benchmark {benchmark}   (diamonds: the paper's final errors)", fontsize=11)
    plots.legend(figure, panels)
    return figure


def bars(table: Table) -> Figure:
    """Final errors of every benchmark, the paper's as diamonds; lines: one standard deviation."""
    benchmarks = sorted({key[0] for key in table})
    across = min(3, len(benchmarks))
    down = -(-len(benchmarks) // across)
    figure = Figure(figsize=(4 * across + 0.5, 2.9 * down + 0.5), layout="constrained")
    panels = figure.subplots(down, across, squeeze=False).ravel()
    for axes, benchmark in zip(panels, benchmarks, strict=False):
        sizes = sorted({key[1] for key in table if key[0] == benchmark})
        columns = columns_of({key: table[key] for key in table if key[0] == benchmark})
        width = 1 / (len(columns) + 1)
        for number, column in enumerate(columns):
            keys = [(place, (benchmark, size, *column)) for place, size in enumerate(sizes)]
            keys = [(place, key) for place, key in keys if key in table]
            x = np.array([place for place, _ in keys]) + (number - (len(columns) - 1) / 2) * width
            ours = [table[key] for _, key in keys]
            axes.bar(
                x, [entry.mean for entry in ours], width, color=_color(column),
                yerr=[entry.std for entry in ours] if any(e.seeds > 1 for e in ours) else None,
                label=title_of(column),
            )  # fmt: skip
            theirs = [(at, published()[k].mean) for at, (_, k) in zip(x, keys, strict=True)
                      if k in published()]  # fmt: skip
            if theirs:
                axes.plot(
                    *zip(*theirs, strict=True), "kD", markersize=3.5, markerfacecolor="w",
                    label="the paper's",
                )  # fmt: skip
        axes.set_title(f"Benchmark {benchmark}", fontsize=10)
        axes.set_xticks(range(len(sizes)), [f"M = {size}" for size in sizes])
        plots.tidy(axes)
    for axes in panels[len(benchmarks) :]:
        axes.set_visible(False)
    for axes in panels[::across]:
        axes.set_ylabel("mean squared error")
    plots.legend(figure, panels[: len(benchmarks)])
    return figure


def code_dims(results: Sequence[Result]) -> Figure:
    """Final error of ESC over d3, a line for each size of the test sets."""
    rule = required_code_dim(MAX_VEHICLES, VEHICLE_DIM)
    figure, axes = _panel()
    for size in TEST_SIZES:
        pairs = [(r.cell.code_dim, r.points[-1].errors[size]) for r in results]
        _means(axes, pairs, color=SIZES_COLORS[size], label=f"M = {size}")
    axes.axvline(rule, color="0.4", linestyle="--", linewidth=1)
    axes.annotate(
        f"N·d1 + 1 = {rule}", (rule, 0.97), xycoords=axes.get_xaxis_transform(), va="top",
        xytext=(4, 0), textcoords="offset points", fontsize=9, color="0.3",
    )  # fmt: skip
    axes.set_xscale("log")
    ticks = sorted({r.cell.code_dim for r in results})
    axes.set_xticks(ticks, map(str, ticks), minor=False)
    axes.minorticks_off()
    _log_scale(axes)
    axes.set_xlabel("d3, size of the set code")
    axes.set_ylabel("mean squared error")
    axes.legend(frameon=False, fontsize=9)
    return figure


def truncation(results: Sequence[Result]) -> Figure:
    """Final error of FP over Z of M = 20 vehicles, beside ESC and the mean as prediction."""
    figure, axes = _panel()
    fp = [r for r in results if r.cell.repr == "fp"]
    pairs = [(r.cell.slots or MAX_VEHICLES, r.points[-1].errors[MAX_VEHICLES]) for r in fp]
    _means(axes, pairs, color=COLORS["fp", "fixed"], label="FP, which takes the Z nearest")
    esc = [r.points[-1].errors[MAX_VEHICLES] for r in results if r.cell.repr == "esc"]
    if esc:
        axes.axhline(
            float(np.mean(esc)), color=COLORS["esc", "fixed"], label="ESC, which takes all"
        )
    benchmark = results[0].cell.benchmark
    variance = TARGETS[benchmark](Samples("test", 0, MAX_VEHICLES).all()).var().item()
    axes.axhline(
        variance, color="0.4", linestyle="--", linewidth=1, label="the mean, without looking"
    )
    axes.set_xticks(sorted({z for z, _ in pairs}))
    axes.set_ylim(bottom=0)
    axes.set_xlabel(f"Z, vehicles taken of M = {MAX_VEHICLES}")
    axes.set_ylabel("mean squared error")
    axes.set_title(f"Benchmark {benchmark}", fontsize=10)
    axes.legend(frameon=False, fontsize=9)
    return figure


def change_of_places(results: Sequence[Result]) -> Figure:
    """Outputs while the vehicle [j, 2] passes [1, 5], which FP sorts by their first feature."""
    tensor, sets = overtaking()
    j = tensor.numpy()
    figure, axes = _panel()
    target = TARGETS[results[0].cell.benchmark](sets).numpy()
    axes.plot(j, target, color="0.2", linestyle="--", linewidth=1.2, label="target")
    seen: set[str] = set()
    for r in results:
        column = column_of(r.cell)
        label = title_of(column) if r.cell.repr not in seen else None
        seen.add(r.cell.repr)
        outputs = np.array(r.overtaking)
        after = int(np.searchsorted(j, 1, side="right"))
        for part in (slice(None, after), slice(after, None)):  # a gap where the order changes
            axes.plot(j[part], outputs[part], color=_color(column), label=label, linewidth=1.5)
            label = None
    axes.axvline(1, color="0.7", linewidth=0.8, zorder=0)
    axes.set_xlabel("j, first feature of the vehicle that passes")
    axes.set_ylabel("output")
    axes.legend(frameon=False, fontsize=9)
    return figure


def _means(axes: Axes, pairs: Iterable[tuple[int, float]], color: str, label: str) -> None:
    """A line through the means over seeds, and every seed as a dot."""
    values: dict[int, list[float]] = {}
    for x, y in pairs:
        values.setdefault(x, []).append(y)
    places = sorted(values)
    axes.plot(
        places, [float(np.mean(values[x])) for x in places], marker="o", color=color, label=label
    )
    for x in places:
        if len(values[x]) > 1:
            axes.plot([x] * len(values[x]), values[x], ".", color=color, alpha=0.5)


def _columns(results: Iterable[Result]) -> list[Column]:
    present = dict.fromkeys(column_of(r.cell) for r in results)
    return sorted(present, key=lambda column: [*COLORS, column].index(column))


def _color(column: Column) -> str:
    return COLORS.get(column, plots.GREY)


def _panel() -> tuple[Figure, Axes]:
    figure = Figure(figsize=(6.5, 4), layout="constrained")
    axes = figure.subplots()
    plots.tidy(axes)
    return figure, axes


def _log_scale(axes: Axes) -> None:
    """Of errors, with plain numbers at the ticks."""
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1, 0.5)))
