"""esc-eval's work: a run's policy on fixed seeds, on film too."""

from __future__ import annotations

import os
from dataclasses import asdict
from pathlib import Path

from esc_agents import files
from esc_agents.driving.episodes import Summary, as_rows, evaluate, model_policy, table
from esc_agents.driving.films import film
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError, say
from esc_agents.reporting.tables import show, terminal
from esc_agents.training import run_directory
from esc_agents.training.callbacks import StopOnSignal
from esc_agents.training.models import load_model


def evaluate_run(
    run_dir: Path, episodes: int, seed: int, shuffle: bool, video: Path | None, videos: int,
    json_file: Path | None, device: str, trust: bool,
) -> Summary:  # fmt: skip
    """Evaluate the model of ``run_dir`` on ``episodes`` seeds from ``seed`` on; print the table.

    shuffle: permute the vehicles of every observation. video: folder for GIFs of the first
    ``videos`` episodes. json_file: for summary and episodes. trust: load a pickle if need be.
    """
    config = run_directory.open_run(run_dir, trust).model_copy(update={"device": device})
    model, steps = load_model(config, run_dir, trust)
    _check_outputs(video, json_file)
    envs = vectorise(config, min(config.n_envs, episodes), evaluation=True, shuffle=shuffle)
    try:
        with StopOnSignal() as stop:
            seeds = range(seed, seed + episodes)
            drives = evaluate(envs, model_policy(model), seeds, lambda: stop.interrupted)
    finally:
        envs.close()
    if stop.interrupted:
        raise KeyboardInterrupt
    summary = Summary.of(drives)
    name = f"{config.repr}, shuffled" if shuffle else config.repr
    title = f"{config.env}, {config.algo}, {steps:,} steps; "
    title += f"episodes: {episodes} from seed {seed}"
    show(terminal(table({name: summary}), title))
    if json_file:
        report = {**as_rows({name: summary})[0], "drives": [asdict(drive) for drive in drives]}
        files.write_json(json_file, report)
        say(f"Results: {json_file}")
    if video:
        for drive in drives[:videos]:
            say(f"Video: {film(config, model_policy(model), drive.seed, video, shuffle)}")
    return summary


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
