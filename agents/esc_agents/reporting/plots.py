"""What all figures of the package share: colours of representations, bands, legends."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from esc_agents.reporting.statistics import mean_interval

# Okabe and Ito's colours, which colour-blind people tell apart.
COLORS = {
    "esc": "#0072b2", "esc-exp": "#56b4e9", "fp": "#e69f00", "ap": "#d55e00", "mean": "#009e73",
    "max": "#cc79a7", "attention": "#999933",
}  # fmt: skip
GREY = "0.4"


def color(representation: str) -> str:
    """Grey for those that are not the package's own."""
    return COLORS.get(representation, GREY)


def band(
    axes: Axes, x: Sequence[float], runs: Sequence[Sequence[float]], color: str, label: str
) -> None:
    """The mean over runs [runs, len(x)], and its 95 % interval (Student's t)."""
    mean, low, high = np.array([mean_interval(values) for values in zip(*runs, strict=True)]).T
    axes.plot(x, mean, color=color, label=label, linewidth=1.5)
    if len(runs) > 1:
        axes.fill_between(x, low, high, color=color, alpha=0.2, linewidth=0)


def tidy(axes: Axes) -> None:
    """No frame where there is no axis."""
    axes.spines[["top", "right"]].set_visible(False)


def legend(figure: Figure, panels: Iterable[Axes]) -> None:
    """One for all panels, below them."""
    found: dict[str, Any] = {}
    for axes in panels:
        for mark, label in zip(*axes.get_legend_handles_labels(), strict=True):
            found.setdefault(label, mark)
    across = len(found) if len(found) <= 4 else 3
    figure.legend(
        list(found.values()), list(found), loc="outside lower center", ncols=across, frameon=False
    )
