"""What a search found, as a page, and its best settings as a scenario."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import optuna

from esc_agents import files
from esc_agents.config import dump
from esc_agents.errors import say
from esc_agents.reporting import documents
from esc_agents.reporting.documents import Block, Heading, Rows, Text
from esc_agents.reporting.statistics import mean_interval
from esc_agents.reporting.tables import show, terminal
from esc_agents.tuning.search import as_known
from esc_agents.tuning.settings import TuneConfig, train_config
from esc_agents.tuning.trials import JUDGED, Tried
from esc_agents.yaml_text import flow

SHOWN = 10  # trials in the table
BEST = "best.yaml"


def write_report(
    config: TuneConfig, tried: Sequence[Tried], finals: Sequence[Tried], out: Path
) -> None:
    """Write README.md, README.html and best.yaml; print the table of finalists."""
    best = _best(tried, finals)
    title = f"Settings of {config.env}, {config.repr}, {config.algo}"
    documents.write(out, "README", title, list(_blocks(config, tried, finals, best)))
    settings = train_config(config, best.parameters, 0, full=True)
    own = settings.model_copy(update={"evaluation": type(settings.evaluation)()})
    files.write_text(out / BEST, f"# esc-train --config {BEST}\n{dump(own)}")
    show(terminal(_final_rows(config, finals) or _trial_rows(config, tried), title))
    say(f"Report: {out / 'README.md'}; settings: {out / BEST}")


def _best(tried: Sequence[Tried], finals: Sequence[Tried]) -> Tried:
    """The trial with the highest mean over its runs, of the finalists if there are any."""
    values: dict[int, list[float]] = {}
    for run in finals or tried:
        if run.value is not None:
            values.setdefault(run.number, []).append(run.value)
    means = {number: float(np.mean(found)) for number, found in values.items()}
    return tried[max(means, key=lambda number: means[number])] if means else tried[0]


def _blocks(
    config: TuneConfig, tried: Sequence[Tried], finals: Sequence[Tried], best: Tried
) -> Iterator[Block]:
    steps = train_config(config, {}, 0).steps
    pruned, failed = sum(t.pruned for t in tried), sum(bool(t.problem) for t in tried)
    yield Text(
        f"{len(tried)} trials of {steps:,} steps, one run each; ended early: {pruned}, "
        f"not possible to run: {failed}. They were chosen {config.round} at a time by Optuna's "
        f"TPE, of the trials before. Returns are means of the last {JUDGED} evaluations, on "
        "episodes that no study uses. Trial 0 is the scenario as it is shipped."
    )
    if finals:
        full = train_config(config, {}, 0, full=True).steps
        yield Heading("Finalists")
        yield Text(
            f"The best trials again, beside the shipped settings: {full:,} steps, {config.seeds} "
            "runs each, mean return and 95 % interval over runs. Being the best of many trials is "
            "partly luck; of these runs nothing was chosen but the last line."
        )
        yield Rows(_final_rows(config, finals))
    yield Text(f"Taken: trial {best.number} (`{BEST}`).")
    yield Heading("Trials")
    yield Rows(_trial_rows(config, tried))
    if importances := _importances(config, tried):
        yield Heading("What mattered")
        yield Text(
            "Optuna's PED-ANOVA: how much each setting has to do with being among the best trials; "
            "of few trials it is a hint."
        )
        yield Rows([("setting", "share"), *((k, f"{v:.0%}") for k, v in importances.items())])
    made = sorted({flow(t.made_with) for t in (*tried, *finals)})
    yield Heading("Made with")
    yield Text("\n".join(f"`{versions}`" for versions in made), bullets=True)


def _final_rows(config: TuneConfig, finals: Sequence[Tried]) -> list[list[str]]:
    if not finals:
        return []
    rows = [["trial", "return", "crashes", *config.space]]
    for number in dict.fromkeys(run.number for run in finals):
        runs = [run for run in finals if run.number == number]
        mean, low, high = mean_interval([run.value or 0.0 for run in runs])
        crashed = np.mean([np.mean(run.crashed[-JUDGED:]) for run in runs])
        rows.append([str(number), f"{mean:.2f} [{low:.2f}, {high:.2f}]", f"{crashed:.0%}",
                     *_cells(config, runs[0])])  # fmt: skip
    return rows


def _trial_rows(config: TuneConfig, tried: Sequence[Tried]) -> list[list[str]]:
    ranked = sorted((t for t in tried if t.value is not None), key=lambda t: -(t.value or 0.0))
    rows = [["trial", "return", "crashes", *config.space]]
    for t in ranked[:SHOWN]:
        crashed = np.mean(t.crashed[-JUDGED:])
        rows.append([str(t.number), f"{t.value:.2f}", f"{crashed:.0%}", *_cells(config, t)])
    return rows


def _cells(config: TuneConfig, tried: Tried) -> list[str]:
    """A run's settings; those of the shipped scenario are left empty."""
    values = [tried.parameters.get(key, "") for key in config.space]
    return [f"{v:.3g}" if isinstance(v, float) else str(v) for v in values]


def _importances(config: TuneConfig, tried: Sequence[Tried]) -> dict[str, float]:
    study = optuna.create_study(direction="maximize")
    study.add_trials([as_known(config, t.parameters, t.value, t.returns) for t in tried])
    if len([t for t in study.trials if t.value is not None]) < SHOWN:
        return {}
    return optuna.importance.get_param_importances(
        study, evaluator=optuna.importance.PedAnovaImportanceEvaluator()
    )
