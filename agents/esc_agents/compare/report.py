"""The report of a comparison: who drives best where."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Sequence
from math import isinf
from pathlib import Path
from typing import Any

from esc_agents import files
from esc_agents.compare import figures
from esc_agents.compare.analysis import (
    Task,
    above_floor,
    drivers,
    duels,
    evaluated,
    load,
    missing,
    overall,
    overall_duels,
    row,
    run_rows,
    shuffle,
    summary_rows,
    transfer,
)
from esc_agents.compare.fairness import fairness, tuning
from esc_agents.compare.films import film_of
from esc_agents.compare.grid import EPISODES, TUNING_EPISODES
from esc_agents.errors import UserError, say
from esc_agents.reporting.documents import Block, Heading, Rows, Text, picture, write
from esc_agents.reporting.statistics import Estimate, mean_interval
from esc_agents.reporting.tables import show, terminal
from esc_agents.training.run_directory import commands
from esc_agents.yaml_text import flow

TITLE = "Representations of traffic, compared"
COLUMNS = (
    "", "runs", "return", "IQM", "collisions", "speed m/s", "progress m", "lane changes",
    "min TTC s", "off road",
)  # fmt: skip
NOTE = """\
Return: mean over runs, with a stratified bootstrap 95 % interval; IQM: mean of the middle half of \
the runs. Collisions: of all episodes of all runs, with Wilson's interval. Of drivers that learn \
nothing the intervals are over episodes. Min TTC: median over episodes of the least time to \
collision. Every driver drove the same episodes. The planner, where there is one, tries every \
first action, and is no more than a reference: `esc-eval --expert planner` tries every \
second one, too."""


def write_report(out: Path, trust: bool = False) -> None:
    """Print the tables of what ``out`` holds; write report.html, .md, CSV files and pictures."""
    tasks = load(out, trust)
    if not tasks:
        raise UserError(f"expected results of esc-compare in {out}, found none")
    blocks = [
        *verdicts(tasks), *details(tasks), *learning(tasks), *robustness(tasks), *transfers(tasks),
        *films(tasks, out, trust), *fairness(tasks), *tuning(tasks), *provenance(tasks, out),
    ]  # fmt: skip
    for task in tasks:
        show(terminal(list(table(task)), task.name))
        for sentence in missing(task):
            say(sentence)
    for name, lines in {"summary": summary_rows(tasks), "runs": run_rows(tasks)}.items():
        files.write_text(out / f"{name}.csv", as_csv(lines))
    written = write(out, "report", TITLE, blocks)
    say(f"Written into {out}: {', '.join(path.name for path in written)}, summary.csv, runs.csv")


def verdicts(tasks: Sequence[Task]) -> Iterator[Block]:
    """The answer, in words first."""
    lines = []
    fought = [(task.name, duel) for task in tasks for duel in duels(task)]
    for pair in dict.fromkeys((duel.ours, duel.rival) for _, duel in fought):
        found = {name: duel for name, duel in fought if (duel.ours, duel.rival) == pair}
        counts = [
            f"{verdict} in {len(names)} ({'; '.join(names)})"
            for verdict in ("wins", "ties", "loses", "has too few runs to tell")
            if (names := [name for name, duel in found.items() if duel.verdict == verdict])
        ]
        lines.append(f"**{pair[0]} against {pair[1]}**: {', '.join(counts)}.")
    if lines:
        yield Text("\n".join(lines), bullets=True)
        yield Text(
            "A win or a loss is a difference of mean returns whose 95 % interval (Welch's t, over "
            "runs) does not hold 0; of twenty comparisons without any difference one would still "
            "be called so. A tie says that these runs show no difference, not that there is none: "
            "with few runs the interval is wide."
        )
        yield Rows([["", "difference of returns", "probability of improvement", ""], *(
            [f"{name}: {d.ours} against {d.rival}", interval(d.difference, sign=True),
             interval(d.better, percent=True), d.verdict]
            for name, d in fought
        )])  # fmt: skip
        alt = "Probability that a run of ours has a higher return than one of a rival"
        yield picture("improvement", figures.improvement(tasks), alt)
    if len(tasks) > 1:
        yield from _overall(tasks)
    yield Text("\n".join(_floors(tasks)), bullets=True)


def _overall(tasks: Sequence[Task]) -> Iterator[Block]:
    if found := overall(tasks):
        yield Text(
            "IQM of returns over all scenarios, on a scale where 0 is the best blind policy of the "
            "scenario and 1 is IDM/MOBIL (not where that is no better, or missing), of "
            "representations that ran in all; and the probability that ours improve on a rival, "
            "mean over the scenarios that both ran in:"
        )
        better = overall_duels(tasks)
        ours = list(dict.fromkeys(ours for ours, _ in better))
        yield Rows([["", "IQM", *(f"improvement by {name}" for name in ours)], *(
            [repr, interval(found[repr]) if repr in found else "",
             *(interval(better[name, repr], percent=True) if (name, repr) in better else ""
               for name in ours)]
            for repr in dict.fromkeys([*found, *(rival for _, rival in better)])
        )])  # fmt: skip


def _floors(tasks: Sequence[Task]) -> Iterator[str]:
    for task in tasks:
        name, floor = task.floor
        below = [repr for repr in task.reprs if not above_floor(task, repr)]
        best = f"the best blind policy ({name}, {floor.reward:.2f}"
        best += f" [{floor.reward_low:.2f}, {floor.reward_high:.2f}])"
        yield (
            f"{task.name}: not clearly above {best}: {', '.join(below)}."
            if below
            else f"{task.name}: every representation is above {best}."
        )


def details(tasks: Sequence[Task]) -> Iterator[Block]:
    """A table for each scenario, and the bars."""
    yield Heading("Final policies")
    yield Text(NOTE)
    alt = "Mean return of each representation's final policies, by scenario"
    yield picture("bars", figures.bars(tasks), alt)
    for task in tasks:
        runs = [run for repr in task.reprs for run in task.runs(repr)]
        seeds = sorted({run.cell.seed for run in runs})
        steps = f"{task.settings['steps'] or runs[0].config['steps']:,} training steps"
        if task.imitated:
            steps = f"{runs[0].curve['timesteps'][-1]:,} labels"
        yield Text(f"**{task.name}**, {steps}, seeds {', '.join(map(str, seeds))}")
        yield Rows(list(table(task)))
        if sentences := missing(task):
            again = f"Remove `{task.folder.name}/baselines.json` to have it tried again."
            yield Text(" ".join([*sentences, again]))


def table(task: Task) -> Iterator[list[str]]:
    """The numbers of a scenario, best return of the representations in bold."""
    yield list(COLUMNS)
    found = {repr: row(task, repr) for repr in task.reprs}
    best = max(found, key=lambda repr: found[repr].mean.value)
    for repr, r in found.items():
        name = f"**{repr}**" if repr == best else repr
        numbers = _numbers(r.means, r.min_ttc)
        crash = interval(r.collisions, percent=True)
        yield [name, str(r.runs), interval(r.mean), interval(r.middle), crash, *numbers]
    for name, s in drivers(task).items():
        mean = Estimate(s.reward, s.reward_low, s.reward_high)
        crash = Estimate(s.collision_rate, s.collision_low, s.collision_high)
        numbers = _numbers(vars(s), s.min_ttc)
        yield [name, "", interval(mean), "", interval(crash, percent=True), *numbers]


def _numbers(means: dict[str, Any], min_ttc: float) -> list[str]:
    return [
        f"{means['speed']:.1f}", f"{means['progress']:.0f}", f"{means['lane_changes']:.1f}",
        "none" if isinf(min_ttc) else f"{min_ttc:.1f}", f"{means['off_road']:.1%}",
    ]  # fmt: skip


def learning(tasks: Sequence[Task]) -> Iterator[Block]:
    """Curves."""
    yield Heading("Learning")
    yield Text(
        "Return on fixed episodes during training, mean over runs; bands are 95 % intervals over "
        "runs (Student's t). Other and fewer episodes than those above: the levels do not compare."
    )
    alt = "Return over training steps of each representation, by scenario"
    yield picture("curves", figures.curves(tasks), alt)
    if in_portions := [task for task in tasks if task.in_portions]:
        yield from _regrets(in_portions)


def _regrets(tasks: Sequence[Task]) -> Iterator[Block]:
    """How much of what the expert knows is learned from how many labels."""
    yield Text(
        "Regret: on states that were held out, what the best action is worth to the expert, less "
        "what the action chosen is, in units of the return; mean over runs, with 95 % intervals "
        "over runs (Student's t). Each number of labels was learned from anew, with as many "
        "passes: a few labels make few updates. One action: the one that is best on average."
    )
    alt = "Held-out regret over the number of labels of each representation, by scenario"
    yield picture("regret", figures.regrets(tasks), alt)
    for task in tasks:
        labels = evaluated(task.runs(task.reprs[0]))
        lines = [["", *(f"{number:,.0f} labels" for number in labels)]]
        for repr in task.reprs:
            curves = [run.curve["regret"][: len(labels)] for run in task.runs(repr)]
            means = [Estimate(*mean_interval(found)) for found in zip(*curves, strict=True)]
            lines.append([f"{task.name}: {repr}", *map(interval, means)])
        blind = task.runs(task.reprs[0])[0].curve["blind_regret"][-1]
        lines.append([f"{task.name}: one action", *[""] * (len(labels) - 1), f"{blind:.2f}"])
        yield Rows(lines)


def robustness(tasks: Sequence[Task]) -> Iterator[Block]:
    """What the order of the vehicles does to policies."""
    yield Heading("Does the order of the vehicles matter?")
    yield Text(
        "The same episodes with the vehicles of every observation in random order. `ap` is trained "
        "that way and never drives otherwise: its two returns are the same, what order does to it "
        "is in its decisions. The others saw the simulator's order, and `fp` sorts by itself. "
        "Decisions: how many come out differently if the vehicles of one observation change places "
        "(of continuous actions: mean change, of a range from -1 to 1). Features: largest change "
        "in proportion to the largest feature. A float has 24 bits, so 1e-6 is rounding."
    )
    header = ["", "return", "shuffled", "change", "decisions changed", "features changed"]
    lines = []
    for task in tasks:
        for repr in task.reprs:
            s = shuffle(task, repr)
            lines.append(
                [
                    f"{task.name}: {repr}", f"{s.plain:.2f}", f"{s.shuffled:.2f}",
                    interval(s.change, sign=True), f"{s.changed:.2%} of {s.decisions:,}",
                    f"{s.features:.1e}",
                ]
            )  # fmt: skip
    yield Rows([header, *lines])
    if churn := list(_churn(tasks)):
        yield Text(
            "Slots that hold another vehicle than a decision before: what a network must follow "
            "that has a place for each vehicle."
        )
        yield Rows([["", "slots Z", "changed hands"], *churn])


def _churn(tasks: Sequence[Task]) -> Iterator[list[str]]:
    for task in tasks:
        for repr in task.reprs:
            runs = task.runs(repr)
            if known := [run.churn for run in runs if run.churn is not None]:
                share = sum(known) / len(known)
                yield [f"{task.name}: {repr}", str(runs[0].slots), f"{share:.0%}"]


def transfers(tasks: Sequence[Task]) -> Iterator[Block]:
    """Other traffic than that of training."""
    for task in tasks:
        if not task.settings["transfer"]:
            continue
        yield Heading(f"Other traffic: {task.name}")
        changes = "; ".join(
            f"{name}: `{flow(config)}`" for name, config in task.settings["transfer"].items()
        )
        yield Text(
            f"Mean return, trained in one traffic and driven in another. {changes}. Where there "
            "are more vehicles the set is larger (N): `fp` and `ap` keep the Z that they were "
            "trained with."
        )
        reprs = [repr for repr in task.reprs if transfer(task, repr)]
        alt = "Matrix of mean returns for each representation, traffic of training by of driving"
        name = f"transfer-{task.folder.name}"
        yield picture(name, figures.transfers(task, reprs), alt)


def films(tasks: Sequence[Task], out: Path, trust: bool) -> Iterator[Block]:
    """The same episode, driven by each representation."""
    made = [image for task in tasks if (image := film_of(task, out, trust))]
    if made:
        yield Heading("On the road")
        yield Text("The same episode with each representation's first run at the wheel.")
        yield from made


def provenance(tasks: Sequence[Task], out: Path) -> Iterator[Block]:
    """What the numbers were made with."""
    yield Heading("How this was made")
    results = [result for task in tasks for result in task.results]
    hours = sum(r.seconds for r in [*results, *(t for task in tasks for t in task.tuned)]) / 3600
    yield Text(
        f"{len(results)} runs and {sum(len(task.tuned) for task in tasks)} tuning runs, "
        f"{hours:.1f} hours of one core in all. Final policies drove episodes with seeds from "
        f"{EPISODES} on; tuning was judged on those from {TUNING_EPISODES} on. Numbers: "
        "[summary.csv](summary.csv), [runs.csv](runs.csv); every run is a file in its scenario's "
        "`results`, which also holds its whole configuration. Commands:"
    )
    if lines := commands(out):
        yield Text("\n".join(f"`{line}`" for line in lines), bullets=True)
    made = {", ".join(f"{k} {v}" for k, v in result.made_with.items()) for result in results}
    yield Text("Made with:")
    yield Text("\n".join(sorted(made)), bullets=True)


def interval(e: Estimate, *, percent: bool = False, sign: bool = False) -> str:
    """A number and its interval, which is left out where it is not known."""
    form = ".0%" if percent else "+.2f" if sign else ".2f"
    if e.low == e.high:
        return f"{e.value:{form}}"
    return f"{e.value:{form}} [{e.low:{form}}, {e.high:{form}}]"


def as_csv(lines: Iterable[dict[str, Any]]) -> str:
    """Rows as CSV, floats in full."""
    rows = list(lines)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(dict.fromkeys(key for r in rows for key in r)), restval="",
                            lineterminator="\n")  # fmt: skip
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()
