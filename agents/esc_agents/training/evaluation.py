"""esc-eval's work: a run's policy, or an expert, on fixed seeds, on film too."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from esc_agents import files
from esc_agents.config import TrainConfig, config_for_env, scenario_name
from esc_agents.driving import experts
from esc_agents.driving.checks import check_env
from esc_agents.driving.environments import (
    MEANING,
    actions,
    env_config,
    other_meaning,
    wrapper_json,
)
from esc_agents.driving.episodes import (
    Episode,
    Summary,
    as_rows,
    evaluate,
    model_policy,
    table,
)
from esc_agents.driving.films import film
from esc_agents.driving.planner_config import PlannerConfig
from esc_agents.driving.planners import TITLES, make_planner
from esc_agents.driving.rule_driver import RULE
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError, say
from esc_agents.reporting.tables import show, terminal
from esc_agents.training import run_directory
from esc_agents.training.callbacks import StopOnSignal
from esc_agents.training.models import load_model
from esc_agents.yaml_text import flow
from esc_gym.adaptation import adapt
from esc_gym.registration import merge


def evaluate_run(
    run_dir: Path, episodes: int, seed: int, env: str | None, env_config: dict[str, Any],
    shuffle: bool, video: Path | None, videos: int, json_file: Path | None, device: str,
    trust: bool,
) -> Summary:  # fmt: skip
    """Evaluate the model of ``run_dir`` on ``episodes`` seeds from ``seed`` on; print the table.

    env, env_config: another scenario and changes of its traffic, or of the run's. shuffle: permute
    the vehicles of every observation. video: folder for GIFs of the first ``videos`` episodes.
    json_file: for summary and episodes. trust: load a pickle if need be.
    """
    config = run_directory.open_run(run_dir, trust).model_copy(update={"device": device})
    model, steps = load_model(config, run_dir, trust)
    _check_outputs(video, json_file)
    title = f"{scenario_name(config)}, {run_directory.learned(run_dir, config, steps)}; "
    driven = f"{env or scenario_name(config)} {flow(env_config) if env_config else ''}".strip()
    if env or env_config:
        title += f"driving in {driven}; "
        config = _elsewhere(config, env, env_config, model, run_dir)
    else:
        check_env(config)
    envs = vectorise(config, min(config.n_envs, episodes), evaluation=True, shuffle=shuffle)
    try:
        with StopOnSignal() as stop:
            seeds = range(seed, seed + episodes)
            drives = evaluate(envs, model_policy(model), seeds, stop)
    finally:
        envs.close()
    if stop.interrupted:
        raise KeyboardInterrupt
    name = f"{config.repr}, shuffled" if shuffle else config.repr
    summary = _tell(name, title, driven, drives, json_file)
    if video:
        for drive in drives[:videos]:
            path = film(config, model_policy(model), drive.seed, video, shuffle=shuffle)
            say(f"Video: {path}")
    return summary


def evaluate_expert(
    look_ahead: PlannerConfig | None, episodes: int, seed: int, env: str,
    env_config: dict[str, Any], video: Path | None, videos: int, json_file: Path | None,
    trust: bool,
) -> Summary:  # fmt: skip
    """Evaluate a driver that has learned nothing, on ``episodes`` seeds from ``seed`` on.

    look_ahead: how a planner does; None: IDM/MOBIL drive. The others: as of ``evaluate_run``.
    """
    config = config_for_env(env)
    config = config.model_copy(update={"env_config": merge(config.env_config, env_config)})
    planner = make_planner(look_ahead, config, trust) if look_ahead else None
    if planner is None:
        experts.check_rule(config)
    _check_outputs(video, json_file)
    with StopOnSignal() as stop:
        seeds = range(seed, seed + episodes)
        drives = experts.drive(planner, config, seeds, stop)
    if stop.interrupted:
        raise KeyboardInterrupt
    driven = f"{env} {flow(env_config) if env_config else ''}".strip()
    name = f"{TITLES[type(planner)]}, knows {planner.knows}" if planner else RULE
    summary = _tell(name, f"{driven}; ", driven, drives, json_file)
    if video:
        for drive in drives[:videos]:
            say(f"Video: {experts.film_expert(planner, config, drive.seed, video)}")
    return summary


def _tell(
    name: str, title: str, driven: str, drives: Sequence[Episode], json_file: Path | None
) -> Summary:
    """Print how it went, and write it into ``json_file``."""
    summary = Summary.of(drives)
    title += f"episodes: {len(drives)} from seed {drives[0].seed}"
    show(terminal(table({name: summary}), title))
    if json_file:
        report = {**as_rows({name: summary})[0], "driven": driven}
        report["drives"] = [asdict(drive) for drive in drives]
        files.write_json(json_file, report)
        say(f"Results: {json_file}")
    return summary


def _elsewhere(
    config: TrainConfig, env: str | None, changes: dict[str, Any], model: Any, run_dir: Path
) -> TrainConfig:
    """A run in other traffic, for which ``model`` is made ready: N follows the traffic.

    Raises UserError where the model would not know what it sees there, or what it does.
    """
    other = config_for_env(env).model_copy(update={"algo": config.algo}) if env else config
    rows = {"max_vehicles": other.observation.max_vehicles}
    there = config.model_copy(
        update={
            "env": other.env,
            "env_config": merge(env_config(other), changes),
            # Merged already, under the changes.
            "continuous": other.continuous
            and other.continuous.model_copy(update={"env_config": {}}),
            "observation": config.observation.model_copy(update=rows),
        }
    )
    probe = check_env(there)
    what = other_meaning(wrapper_json(probe), learned(run_dir), "in training")
    if not what and (does := _actions(there)) != (learned_to := _actions(config)):
        what = f"actions {flow(learned_to)} in training and {flow(does)} here"
    if what:
        raise UserError(
            f"{env or config.env}: expected what the run has learned, got {what}; only a run of "
            "its own can learn that"
        )
    try:
        adapt(getattr(model, "policy", model), probe)
    except ValueError as error:
        raise UserError(f"{env or config.env}: {error}") from error
    return there


def _actions(config: TrainConfig) -> dict[str, Any]:
    """What the actions of a run move."""
    section = actions(config)
    return {name: section.get(name, True) for name in ("type", "longitudinal", "lateral")}


def learned(run_dir: Path) -> dict[str, Any]:
    """What the numbers meant that a run's policy learned from."""
    run_directory.verify(run_dir, "wrapper.json")
    try:
        wrapper = json.loads((run_dir / "wrapper.json").read_bytes())
        return {name: wrapper[name] for name in MEANING}
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise UserError(f"{run_dir / 'wrapper.json'} is damaged or missing: {reason}") from error


def _check_outputs(video: Path | None, json_file: Path | None) -> None:
    """Make the folder for videos; raises UserError now where results could not be written later."""
    if json_file and not json_file.parent.is_dir():
        raise UserError(f"json: folder {json_file.parent} does not exist")
    if json_file and (json_file.is_dir() or not os.access(json_file.parent, os.W_OK)):
        raise UserError(f"json: expected a file that can be written, got {json_file}")
    try:
        if video:
            video.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"video: folder {video}: {error.strerror}") from error
