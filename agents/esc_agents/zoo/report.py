"""What comes with the package and how it drives: a page for all agents, a model card for each.

An agent's line of the page lies beside its weights, so that the zoo can grow scenario by scenario,
and the page says what is in it.
"""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Sequence
from pathlib import Path
from shutil import rmtree
from typing import Any

from esc_agents import files, pretrained
from esc_agents.compare import store
from esc_agents.compare.films import shown, together
from esc_agents.compare.grid import EPISODES, IMITATION
from esc_agents.config import Model, TrainConfig
from esc_agents.driving.baselines import best_blind, is_above
from esc_agents.driving.episodes import Summary, model_policy, return_of
from esc_agents.driving.experts import PLANNER
from esc_agents.driving.films import gif, record
from esc_agents.driving.policies import load_policy
from esc_agents.driving.rule_driver import RULE
from esc_agents.errors import say
from esc_agents.imitation.settings import ImitateConfig
from esc_agents.reporting.tables import markdown
from esc_agents.training.run_directory import commands, write_checksums
from esc_agents.yaml_text import flow
from esc_agents.zoo.keeping import RIVALS, Kept, best_of, keep

ROW = "row.json"  # an agent's line of the page, and what made it
TEXT = """# The zoo

Agents that come with the package. Each row: the final policies of so many runs of the scenario's
recipe, or of imitation of a planner, or of that and then PPO, with as many episodes each from seed
{first:,} on, which no training saw; brackets hold 95 % intervals over all of these episodes. The
agent that is kept is the run which was best at its own evaluations in training. "Above both": the
interval of the return lies above those of every policy that never looks, and of IDM/MOBIL, on the
same episodes. The planner knows all, what the others want too, and tries every first action in
copies of the scene: a reference, and no driver for a road; `esc-eval --expert planner` tries every
second one, too, and in the dense scenarios drives better. Steps: of training, or labels "by
imitation", or both. Minutes: of one run, without the imitation before it, measured.

    esc-eval --pretrained NAME
    esc-train --env SCENARIO --start-from zoo:NAME    # NAME-attention: --repr attention
"""
CARD = """# {name}

Drives `{env}` ({id}), seeing the vehicles within {reach:g} m as a set; representation `{repr}`,
{learned}.

{table}

- Trained and evaluated by: {commands}; seed {seed}. Again: `{train}`
- Made with: {versions}
- Sees: {features} of each vehicle; {ego_features} of itself.
- Knows nothing but highway-env's traffic, in this scenario, as configured in `config.yaml`: it is
  no driver for any road.
"""


def publish(comparison: Path, docs: Path) -> list[Kept]:
    """Put a comparison's best agents into the zoo, in place of what the zoo had for its scenarios,
    and write ``docs``/zoo.md, of all agents that are there, with their films.
    """
    agents, made_by = best_of(comparison), commands(comparison)
    for agent in agents:
        run = store.run_folder(comparison, agent.chosen.cell)
        folder = keep(run, agent.name)
        files.write_text(folder / "README.md", card(agent, made_by))
        made = {"made_by": made_by, "made_with": [run.made_with for run in agent.runs]}
        files.write_json(folder / ROW, {"columns": row(agent), **made})
        write_checksums(folder)
        (docs / "zoo").mkdir(parents=True, exist_ok=True)
        _film(agent, folder, docs / "zoo" / f"{agent.name}.gif")
        say(f"{folder}: {agent.chosen.cell.name} of {agent.task.folder}")
    kept = {agent.name for agent in agents}
    compared = {
        f"{agent.task.settings['env']}-{rival}"
        for agent in agents for rival in RIVALS if rival in agent.task.reprs
    }  # fmt: skip
    for name in compared - kept:
        rmtree(pretrained.folder() / name, ignore_errors=True)  # is no longer better
        (docs / "zoo" / f"{name}.gif").unlink(missing_ok=True)
    files.write_text(docs / "zoo.md", page())
    say(f"Written: {docs / 'zoo.md'}")
    return agents


def page() -> str:
    """docs/zoo.md: all agents of the zoo that a comparison brought there."""
    found = {name: pretrained.folder() / name / ROW for name in pretrained.names()}
    rows = {
        name: json.loads(path.read_text(encoding="utf-8"))
        for name, path in found.items()
        if path.is_file()
    }
    lines = [row["columns"] for row in rows.values()]
    columns = list(dict.fromkeys(column for line in lines for column in line))
    table = markdown([columns, *([line.get(column, "") for column in columns] for line in lines)])
    films = [f"### {name}\n\n![{name}, one episode](zoo/{name}.gif)" for name in rows]
    made_by = dict.fromkeys(command for row in rows.values() for command in row["made_by"])
    made = "\n".join(f"- `{line}`" for line in [*made_by, *_versions(rows.values())])
    text = TEXT.format(first=EPISODES)
    parts = [text, table, f"Made by, and with:\n\n{made}", "## Films", *films]
    return "\n".join(f"{part.strip()}\n" for part in parts)


def _versions(rows: Iterable[dict[str, Any]]) -> list[str]:
    """Each set of versions once, with all commits of this package that were run with it."""
    found: dict[str, set[str]] = {}
    for made_with in (made for row in rows for made in row["made_with"]):
        others = {name: version for name, version in made_with.items() if name != "commit"}
        found.setdefault(flow(others), set()).add(made_with.get("commit", "unknown"))
    return [f"{versions}, commits: {', '.join(sorted(c))}" for versions, c in found.items()]


def row(agent: Kept) -> dict[str, Any]:
    """An agent's line of the table, by column."""
    summary, (blind, rule) = agent.summary, rivals(agent)
    planner = agent.task.baselines.planner
    minutes = sum(run.seconds for run in agent.runs) / len(agent.runs) / 60
    return {
        "agent": agent.name,
        "return": return_of(summary),
        "crashes": crashes(summary),
        "arrived": arrivals(summary),
        "speed m/s": f"{summary.speed:.1f}",
        "best blind policy": said(blind),
        RULE: said(rule) if rule else "cannot drive",
        PLANNER: said(planner) if planner else "",
        "above both": "yes" if above(agent) else "no",
        "runs x episodes": f"{len(agent.runs)} x {len(agent.chosen.drives[''])}",
        "steps": steps(agent),
        "minutes": f"{minutes:.0f}",
    }


def rivals(agent: Kept) -> tuple[Summary, Summary | None]:
    """(the best policy that never looks, IDM/MOBIL if it can drive there)."""
    baselines = agent.task.baselines
    return baselines.blind[best_blind(baselines.blind)], baselines.rule


def above(agent: Kept) -> bool:
    """Whether the return is clearly above those of both."""
    baselines = agent.task.baselines
    return is_above(
        agent.summary, baselines.blind | ({RULE: baselines.rule} if baselines.rule else {})
    )


def steps(agent: Kept) -> str:
    """Of training, or labels, or both."""
    own = f"{TrainConfig.model_validate(agent.chosen.config).steps:,}"
    if agent.chosen.cell.algo == IMITATION:
        return f"{own} by imitation"
    teacher = taught_by(agent)
    return f"{labels(teacher)} by imitation, then {own}" if teacher else own


def labels(teacher: dict[str, Any]) -> str:
    """Of ``taught_by``: what each run learned from at least."""
    return f"{ImitateConfig.model_validate(_given(teacher)).train_config().steps:,}"


def crashes(summary: Summary) -> str:
    low, high = summary.collision_low, summary.collision_high
    return f"{summary.collision_rate:.1%} [{low:.1%}, {high:.1%}]"


def arrivals(summary: Summary) -> str:
    return "" if summary.arrived is None else f"{summary.arrived:.0%}"


def said(summary: Summary) -> str:
    """Another driver, in short."""
    return f"{return_of(summary)}, {summary.collision_rate:.0%} crashes"


def card(agent: Kept, made_by: Sequence[str]) -> str:
    """An agent's README.md."""
    run, (blind, rule) = agent.chosen, rivals(agent)
    config, own = TrainConfig.model_validate(run.config), Summary.of(run.drives[""])
    rows = [("", "return", "crashes", "arrived", "speed m/s")]
    drivers = [(agent.name, own), ("best policy that never looks", blind)]
    for name, summary in [*drivers, (RULE, rule), (PLANNER, agent.task.baselines.planner)]:
        if summary:
            said_of = return_of(summary), crashes(summary), arrivals(summary)
            rows.append((name, *said_of, f"{summary.speed:.1f}"))
    seen = config.observation
    return CARD.format(
        name=agent.name, env=run.cell.env, id=config.env, reach=seen.perception_distance,
        repr=run.cell.repr, learned=learned(agent),
        table=markdown(rows), commands=", ".join(f"`{line}`" for line in made_by),
        seed=run.cell.seed,
        train=command(agent),
        versions=flow(run.made_with), features=", ".join(seen.features),
        ego_features=", ".join(seen.ego_features or ["what the scenario has"]),
    )  # fmt: skip


def learned(agent: Kept) -> str:
    """How an agent came to be, in words."""
    config, way = TrainConfig.model_validate(agent.chosen.config), agent.chosen.cell.algo
    if way == IMITATION:
        return f"learned by imitation of a planner, from {config.steps:,} labels or more"
    words = f"trained with {way.upper()} for {config.steps:,} steps"
    if teacher := taught_by(agent):
        return f"{words}, after imitation of a planner, from {labels(teacher)} labels or more"
    return f"{words}, from {config.start_from} on" if config.start_from else words


def taught_by(agent: Kept) -> dict[str, Any] | None:
    """Settings of the comparison by imitation, with one of whose runs the training began."""
    start = agent.chosen.config.get("start_from")
    if not start or not (Path(start).parent.parent / "task.yaml").is_file():
        return None
    settings = store.task_settings(Path(start).parent.parent)
    return settings if settings["algo"] == IMITATION else None


def command(agent: Kept) -> str:
    """What trains it again, stage by stage."""
    cell, settings = agent.chosen.cell, agent.task.settings
    own = f"--env {cell.env} --repr {cell.repr} --seed {cell.seed}"

    def imitate(settings: dict[str, Any]) -> str:
        return f"esc-imitate {own}{_flags(_given(settings), ImitateConfig)}"

    if cell.algo == IMITATION:
        return imitate(settings)
    given = {**settings["train"]}
    if cell.algo != TrainConfig().algo:
        given["algo"] = cell.algo
    if settings["steps"]:
        given["steps"] = settings["steps"]
    if start := agent.chosen.config.get("start_from"):
        given["start_from"] = start
    train = f"esc-train {own}{_flags(given, TrainConfig)}"
    if teacher := taught_by(agent):
        return f"{imitate(teacher)} --run-dir {start} && {train}"
    return train


def _given(settings: dict[str, Any]) -> dict[str, Any]:
    """Of a comparison by imitation: fields of every run."""
    return {"expert": "planner", **settings["imitate"]}


def _flags(values: dict[str, Any], model: type[Model], prefix: str = "") -> str:
    """What stands on the command line for fields of a configuration."""
    found = ""
    for name, value in values.items():
        flag, kind = f"{prefix}{name.replace('_', '-')}", model.model_fields[name].annotation
        if isinstance(kind, type) and issubclass(kind, Model):
            found += _flags(value, kind, f"{flag}.")
        elif isinstance(value, bool):
            found += f" --{flag}" if value else f" --{prefix}no-{flag.removeprefix(prefix)}"
        else:
            words = value if isinstance(value, list | tuple) else [flow(value)]
            found += f" --{flag} {shlex.join(map(str, words))}"
    return found


def _film(agent: Kept, folder: Path, path: Path) -> None:
    """One episode of the kept agent."""
    policy, _ = load_policy(folder)
    config = TrainConfig.model_validate(agent.chosen.config)
    frames, rate = record(config, model_policy(policy), EPISODES)
    data = gif(together({agent.name: frames}, rate), shown(rate))
    files.write_atomically(path, lambda file: file.write(data))
