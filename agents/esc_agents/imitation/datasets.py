"""Labelled episodes as a Minari data set, the Farama Foundation's standard, in a directory.

The directory is one of Minari's: with MINARI_DATASETS_PATH=runs/data, merge-dense-planner-v0 is
runs/data/merge-dense-planner-v0. Beside what Minari says of every data set, its metadata say who
labelled, and what the observations mean; infos hold the expert's values.
"""

from __future__ import annotations

import json
import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from shutil import rmtree
from typing import Any

import gymnasium as gym
import numpy as np

from esc_agents import files, yaml_text
from esc_agents.config import TrainConfig
from esc_agents.driving.environments import other_meaning
from esc_agents.errors import UserError
from esc_agents.imitation.labels import Drive
from esc_agents.training.run_directory import verify, write_checksums

NAME = re.compile(r"[-_\w]+-v\d+", re.ASCII)  # of Minari's data sets, without a namespace
DATA = "metadata.json", "main_data.hdf5"
VALUES = "expert_values"
ROOT = "MINARI_DATASETS_PATH"
ABOUT = "esc_gym"  # what of the metadata is ours


def check_name(path: Path) -> None:
    """Raises UserError where a directory's name is none for a data set."""
    if not NAME.fullmatch(path.name):
        raise UserError(f"out: expected a name that ends with a version, as -v0, got {path.name!r}")


def minari() -> Any:
    """The package. Raises UserError where it is not installed."""
    try:
        import h5py  # noqa: F401, what Minari keeps its data in
        import minari
    except ModuleNotFoundError as missing:
        raise UserError(
            f"{missing.name} is not installed; install it with: pip install 'esc-gym[data]'"
        ) from missing
    return minari


def write(path: Path, drives: Sequence[Drive], env: gym.Env, about: dict[str, Any]) -> None:
    """Make the data set ``path`` of all ``drives``: it is there whole, or not at all.

    env: what they were driven in; about: further metadata, for JSON.
    """
    package = minari()
    root = files.temporary_of(path).absolute()  # Minari would take it relative to itself
    try:
        rmtree(root, ignore_errors=True)
        root.mkdir(parents=True)
        with _root(root), warnings.catch_warnings():
            # Minari recommends to name authors, whom only those know who publish the data.
            warnings.filterwarnings(
                "ignore", "`(author|author_email|code_permalink)` is", UserWarning
            )
            made = package.create_dataset_from_buffers(
                path.name, [_buffer(package, drive) for drive in drives],
                env=env.spec, eval_env=env.spec, algorithm_name=about["expert"],
                description=f"Episodes with what {about['expert']} thought of every action, in "
                f"infos[{VALUES!r}]; written by esc-collect",
                observation_space=env.observation_space, action_space=env.action_space,
                requirements=["esc-gym"],
            )  # fmt: skip
            made.storage.update_metadata({ABOUT: json.dumps(about)})
        write_checksums(root / path.name / "data")
        files.put_in_place(root / path.name, path)
    finally:
        rmtree(root, ignore_errors=True)


def check_there(path: Path) -> None:
    """Raises UserError where a directory holds no data set."""
    for name in DATA:
        if not (path / "data" / name).is_file():
            raise UserError(
                f"data: no data set in {path}: expected data/{name} in it, as esc-collect --out "
                "makes it"
            )


def read(
    path: Path, observation: dict[str, Any], actions: int, run: TrainConfig | None = None
) -> list[Drive]:
    """The episodes of a data set.

    observation: what ``wrapper_json`` says of those who are to learn from it; actions: how many
    they have; run: the scenario that they learn to drive in. Raises UserError where the data are
    damaged, too few to hold any out, or are of others.
    """
    package = minari()
    check_there(path)
    folder = path / "data"
    verify(folder, *DATA)
    try:
        data = package.MinariDataset(folder)
        about = json.loads(data.storage.metadata[ABOUT])
        noted = data.storage.get_episode_metadata(range(data.total_episodes))
        drives = [
            _drive(each["seed"], episode)
            for each, episode in zip(noted, data.iterate_episodes(), strict=True)
        ]
    except KeyError as missing:
        raise UserError(
            f"data {path}: expected a data set of esc-collect, got another"
        ) from missing
    except Exception as error:  # whatever HDF5 and JSON make of a file that is none
        raise UserError(f"data {path} is damaged: {type(error).__name__}: {error}") from error
    if what := other_meaning(observation, about["observation"]):
        raise UserError(f"data {path}: expected the same observation, got {what}")
    rows, found = observation["max_vehicles"], about["observation"]["max_vehicles"]
    if rows != found:
        raise UserError(f"data {path}: expected sets of up to N={rows} vehicles, got N={found}")
    if about["actions"] != actions:
        raise UserError(
            f"data {path}: expected labels of {actions} actions, got {about['actions']}"
        )
    if run:
        _check_scenario(path, run.model_dump(mode="json"), yaml_text.parse(about["run"]))
    if len(drives) < 2:
        raise UserError(f"data {path}: expected 2 episodes or more, of which some are held out")
    return drives


def _check_scenario(path: Path, asked: dict[str, Any], found: dict[str, Any]) -> None:
    """Raises UserError where ``found``, the configuration of labels, is of another scenario."""
    if found["env"] != asked["env"]:
        raise UserError(f"data {path}: expected labels of {asked['env']}, got {found['env']}'s")
    own, other = asked["env_config"], found["env_config"]
    keys = sorted(key for key in {**own, **other} if own.get(key) != other.get(key))
    if keys:
        mine, theirs = (
            ", ".join(f"{key}={each.get(key)!r}" for key in keys) for each in (own, other)
        )
        raise UserError(
            f"data {path}: expected labels of the same env_config, {mine}, got {theirs}; give what "
            "they are of with --env-config, or collect anew"
        )


def _buffer(package: Any, drive: Drive) -> Any:
    ends = np.zeros(len(drive.actions), bool)
    ends[-1] = True
    return package.data_collector.EpisodeBuffer(
        seed=drive.seed, observations=drive.observations, actions=drive.actions,
        rewards=drive.rewards, terminations=ends & drive.terminated,
        truncations=ends & (not drive.terminated), infos={VALUES: drive.values},
    )  # fmt: skip


def _drive(seed: int, episode: Any) -> Drive:
    return Drive(
        seed, dict(episode.observations), episode.actions, episode.infos[VALUES],
        episode.rewards, bool(episode.terminations[-1]),
    )  # fmt: skip


@contextmanager
def _root(folder: Path) -> Iterator[None]:
    """Minari knows where its data lie by the environment only."""
    before = os.environ.get(ROOT)
    os.environ[ROOT] = str(folder)
    try:
        yield
    finally:
        del os.environ[ROOT]
        if before is not None:
            os.environ[ROOT] = before
