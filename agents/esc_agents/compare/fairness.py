"""Whether a comparison was a fair question: what was equal, what was not, what was tuned."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from esc_agents.compare.analysis import OURS, Task, tuning_scores
from esc_agents.compare.grid import IMITATION, TUNING_SEED, TuningConfig, candidates
from esc_agents.config import TrainConfig
from esc_agents.reporting.documents import Block, Heading, Rows, Text


def fairness(tasks: Sequence[Task]) -> Iterator[Block]:
    """What was equal, and what was not."""
    yield Heading("Was it fair?")
    yield Text(
        "All representations get the same sets of vehicles with the same features, the same "
        "algorithm and settings but for what was tuned, the same seeds of environments and "
        "networks, the same budget of tuning on seeds that the study does not use."
    )
    lines = []
    for task in tasks:
        for repr in task.reprs:
            runs = task.runs(repr)
            first, chosen = runs[0], runs[0].cell.candidate
            encoder, policy = first.parameters
            minutes = sum(run.seconds for run in runs) / len(runs) / 60
            lines.append(
                [
                    f"{task.name}: {repr}", f"{encoder:,}", f"{policy:,}", str(first.vehicles),
                    "all" if first.slots is None else str(first.slots),
                    f"{chosen.learning_rate:g}", f"{chosen.scale:g}", f"{minutes:.1f}",
                ]
            )  # fmt: skip
    header = [
        "", "parameters of the encoder", "of the policy", "N", "Z", "learning rate x", "code x",
        "minutes a run",
    ]  # fmt: skip
    yield Rows([header, *lines])
    notes = [note for task in tasks for note in differences(task)]
    yield Text("\n".join(notes), bullets=True) if notes else Text("Nothing else differs.")


def differences(task: Task) -> Iterator[str]:
    """What is not equal between the representations of a scenario."""
    firsts = {repr: task.runs(repr)[0] for repr in task.reprs}
    sizes = {repr: result.parameters[0] for repr, result in firsts.items()}
    if ours := [sizes[repr] for repr in OURS if repr in sizes]:
        for repr, size in sizes.items():
            if abs(size - ours[0]) > 0.05 * ours[0]:
                yield f"{task.name}: {repr} has {size / ours[0]:.0%} of ESC's parameters."
    for repr, result in firsts.items():
        if result.slots is not None and result.slots < result.vehicles:
            which = "nearest" if repr == "fp" else "first in a random order"
            yield (
                f"{task.name}: {repr} sees at most the Z={result.slots} vehicles {which}, the "
                f"others up to N={result.vehicles}."
            )
    if len(counts := {len(task.runs(repr)) for repr in task.reprs}) > 1:
        yield f"{task.name}: different numbers of runs, {min(counts)} to {max(counts)}."
    reference = _comparable(firsts[task.reprs[0]].config, task.settings["algo"])
    for result in task.results:
        if not result.cell.traffic:
            config = _comparable(result.config, task.settings["algo"])
            if other := [key for key in reference if config[key] != reference[key]]:
                name = f"{result.cell.repr}, seed {result.cell.seed}"
                yield f"{task.name}: {name} differs in {', '.join(other)}."


def _comparable(config: dict[str, Any], algo: str) -> dict[str, Any]:
    """A training configuration without what belongs to one run, was tuned, or is not used.

    Fields that a run is too old to have are as they are by default: how it was trained.
    """
    unused = {"ppo": {"sac", "continuous"}, "sac": {"ppo"}, IMITATION: {"ppo", "sac", "continuous"}}
    own = {"repr", "seed", "run_dir", "start_from"} | unused[algo]
    config = TrainConfig.model_validate(config).model_dump(mode="json")
    kept = {key: value for key, value in config.items() if key not in own}
    if algo in kept:
        kept[algo] = {k: v for k, v in kept[algo].items() if k != "learning_rate"}
    kept["encoder"] = {k: v for k, v in kept["encoder"].items() if k != "arguments"}
    return kept


def tuning(tasks: Sequence[Task]) -> Iterator[Block]:
    """What every representation was offered, and what it took."""
    if not any(task.tuned for task in tasks):
        return
    yield Heading("Tuning")
    yield Text(
        f"Mean return at the end of shorter runs with seeds from {TUNING_SEED} on, on episodes "
        "that the study does not use. The best, in bold, was taken, of equal ones the first. "
        "Beyond the values that were tried there may be better ones."
    )
    for task in tasks:
        tried = candidates(TuningConfig(**task.settings["tuning"])) if task.tuned else []
        lines = []
        for repr in task.reprs:
            scores = tuning_scores(task.tuned, repr, tried)
            best = max(scores, key=lambda candidate: scores[candidate], default=None)
            cells = {candidate: f"{score:.2f}" for candidate, score in scores.items()}
            cells |= {best: f"**{cells[best]}**"} if best else {}
            lines.append([repr, *(cells.get(candidate, "") for candidate in tried)])
        if tried:
            yield Text(f"**{task.name}**")
            yield Rows([["", *map(str, tried)], *lines])
