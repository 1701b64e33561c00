"""esc-eval's work: a run's policy on fixed seeds, on film too."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from esc_agents import run
from esc_agents.errors import UserError
from esc_agents.evaluate import Summary, as_rows, evaluate, model_policy
from esc_agents.report import results_table, show
from esc_agents.train import ALGORITHMS, say, vectorise
from esc_agents.video import film


def evaluate_run(
    run_dir: Path, episodes: int, seed: int, shuffle: bool, video: Path | None, videos: int,
    json_file: Path | None, device: str,
) -> Summary:  # fmt: skip
    """Evaluate the model of ``run_dir`` on ``episodes`` seeds from ``seed`` on; print the table.

    shuffle: permute the vehicles of every observation. video: folder for GIFs of the first
    ``videos`` episodes. json_file: for summary and episodes.
    """
    config = run.open_run(run_dir)
    path = run.latest_model(run_dir)
    if json_file and not json_file.parent.is_dir():
        raise UserError(f"json: folder {json_file.parent} does not exist")
    try:
        model = ALGORITHMS[config.algo].load(path, device=device)
    except Exception as error:
        raise UserError(f"{path} is damaged or of another version: {error}") from error
    envs = vectorise(config, min(config.n_envs, episodes), evaluation=True, shuffle=shuffle)
    try:
        drives = evaluate(envs, model_policy(model), range(seed, seed + episodes))
    finally:
        envs.close()
    summary = Summary.of(drives)
    name = f"{config.repr}, shuffled" if shuffle else config.repr
    title = f"{config.env}, {config.algo}, {model.num_timesteps:,} steps: {episodes} episodes"
    show(results_table(f"{title} from seed {seed}", {name: summary}))
    if json_file:
        report = {**as_rows({name: summary})[0], "drives": [asdict(drive) for drive in drives]}
        run.write_json(json_file, report)
        say(f"Results: {json_file}")
    if video:
        for drive in drives[:videos]:
            say(f"Video: {film(config, model_policy(model), drive.seed, video, shuffle)}")
    return summary
