"""esc-imitate's work: a run directory whose policy was learned from an expert's labels.

<run>/imitate.yaml      what the run is, beside config.yaml, the same as a run of esc-train
      labels/*.npz      the labels of each round
      rounds/*          what the policy was after each round

A round follows from the seed and what the rounds before it left, and from nothing else: one that
was killed is done anew, and ends as it would have.
"""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from esc_agents import files
from esc_agents.config import TrainConfig, dump, load
from esc_agents.driving.baselines import action_names
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check
from esc_agents.driving.environments import wrapper_json
from esc_agents.driving.episodes import model_policy
from esc_agents.driving.policies import load_policy, save_policy
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.errors import UserError, say
from esc_agents.imitation import datasets, labels
from esc_agents.imitation.experts import Expert, expert_of
from esc_agents.imitation.labels import Drive, Labels
from esc_agents.imitation.learning import fit, measure
from esc_agents.imitation.settings import ImitateConfig
from esc_agents.training import run_directory
from esc_agents.training.callbacks import StopOnSignal
from esc_agents.training.models import describe, new_model
from esc_agents.training.results import finish, results, rule_summary
from esc_agents.training.run_directory import IMITATE


def imitate(config: ImitateConfig, resume: Path | None = None, trust: bool = False) -> bool:
    """Learn as ``config`` says; prints the results. False where a signal ended it early.

    resume: an existing run directory, which goes on after its last whole round. trust: also load
    what others wrote and can run their code.
    """
    run = config.train_config()
    directory = resume or run.run_dir or run_directory.default_run_dir(run, "imitation")
    if resume is None:
        run_directory.check_free(directory)
    elif run_directory.finished(resume):
        raise UserError(f"{resume} is finished: there is nothing to continue")
    probe: Any = check(run)
    expert, given = _labellers(config, run, probe, trust)
    with ExitStack() as stack:
        envs: Any = stack.enter_context(closing(BatchVecEnv(run, run.n_envs, evaluation=True)))
        model: Any = new_model(run, envs)
        if resume is None:
            texts = {IMITATE: dump(config)}
            run_directory.create(directory, run, wrapper_json(probe), str(model.device), texts)
        else:
            run_directory.note_command(resume)
        stack.enter_context(run_directory.locked(directory))
        stop = stack.enter_context(StopOnSignal())
        say(describe(run, model, probe))
        say(f"{config.dagger_rounds + 1} rounds of {config.labels:,} labels into {directory}")
        Imitation(config, directory, model, wrapper_json(probe)).learn(envs, expert, given, stop)
        rule = None if stop() else rule_summary(run, stop)
        count = min(run.n_envs, run.evaluation.episodes)
        judges = stack.enter_context(closing(vectorise(run, count, evaluation=True)))
        found = results(run, model_policy(model), judges, action_names(probe), rule, stop)
        if stop():
            say(f"Stopped; continue with: esc-imitate --resume {directory}")
            return False
        finish(run, directory, found, f"imitation, {model.num_timesteps:,} labels")
        return True


def open_imitation(directory: Path, trust: bool = False) -> ImitateConfig:
    """What a run of esc-imitate is. Raises UserError where ``directory`` holds none."""
    if not (directory / IMITATE).is_file():
        raise UserError(f"{directory} is no run of esc-imitate: expected {IMITATE} in it")
    return load(directory / IMITATE, "imitate", ImitateConfig, trust)


def _labellers(
    config: ImitateConfig, run: TrainConfig, probe: Any, trust: bool
) -> tuple[Expert | None, list[Drive] | None]:
    """(who labels, what is labelled already). Raises UserError where there is not enough of it."""
    if (config.expert, config.data) == (None, None):
        raise UserError("expected --expert NAME, who labels, or --data DIR, of esc-collect")
    if config.dagger_rounds and not config.expert:
        raise UserError("rounds: expected --expert, who labels what the learner meets")
    expert = given = None
    if config.expert:
        expert = expert_of(config.expert, config.planner.make(), run, trust)
    if config.data:
        count = int(getattr(probe.action_space, "n", 0))
        given = datasets.read(config.data, wrapper_json(probe), count)
    return expert, given


class Imitation:
    """The rounds of a run; those that an earlier session has finished are taken from the disk."""

    def __init__(
        self, config: ImitateConfig, directory: Path, model: Any, observation: dict[str, Any]
    ) -> None:
        self.config, self.directory, self.model = config, directory, model
        self.observation = observation
        self.drives: list[Drive] = []

    def learn(
        self, envs: BatchVecEnv, expert: Expert | None, given: list[Drive] | None,
        stop: StopOnSignal,
    ) -> None:  # fmt: skip
        """Do all rounds, and write the policy. given: the labels of the first round."""
        for number in range(self.config.dagger_rounds + 1):
            drives = given if given and number == 0 else self._labelled(number, envs, expert, stop)
            if not stop():
                self.drives += drives
                self.model.num_timesteps = sum(len(drive.actions) for drive in self.drives)
                self._learned(number, stop)
        if not stop():
            files.write_atomically(self.directory / "model.zip", self.model.save)
            self._save(self.directory, "policy")

    def _labelled(
        self, number: int, envs: BatchVecEnv, expert: Any, stop: StopOnSignal
    ) -> list[Drive]:
        """Episodes of a round, to the end of the one with the last label."""
        config, path = self.config, self.directory / "labels" / f"{number:03d}.npz"
        if path.exists():
            return labels.load(path)
        driver = model_policy(self.model) if number else None
        noise = 0.0 if number else config.noise
        generator = np.random.default_rng([config.seed, number])
        first = int(generator.integers(10**7, 2**31))  # no evaluation has such seeds
        drives: list[Drive] = []
        while not stop() and sum(len(drive.actions) for drive in drives) < config.labels:
            seeds = range(first + len(drives), first + len(drives) + envs.num_envs)
            drives += labels.collect(envs, seeds, expert, driver, noise, generator, stop)
        if not stop():
            path.parent.mkdir(exist_ok=True)
            labels.save(path, drives)
            mean = np.mean([drive.rewards.sum() for drive in drives])
            who = "the learner drove" if number else f"{config.expert} drove, noise {noise:g}"
            say(f"round {number}: {who}: {len(drives):,} episodes, mean return {mean:.2f}")
        return drives

    def _learned(self, number: int, stop: StopOnSignal) -> None:
        """Train the policy on all labels so far, or load it."""
        folder, name = self.directory / "rounds", f"{number:03d}"
        if (folder / f"{name}.json").exists():
            policy, _ = load_policy(folder, "cpu", name, trust=True)
            self.model.policy.load_state_dict(policy.state_dict())
            return
        learnt, held_out = (Labels.of(part) for part in labels.split(self.drives))
        loss = fit(self.model.policy, learnt, self.config, number, stop)
        if stop():
            return
        found = measure(self.model.policy, held_out)
        metrics = run_directory.MetricsFile(
            self.directory / "metrics.csv", self.model.num_timesteps - 1
        )
        row = {f"imitation/{key}": value for key, value in asdict(found).items()}
        metrics.write({run_directory.STEP: self.model.num_timesteps, **row, "imitation/loss": loss})
        folder.mkdir(exist_ok=True)
        self._save(folder, name)
        say(
            f"round {number}: {len(learnt):,} labels, regret {found.regret:.3f} on "
            f"{len(held_out):,} held out (always the same action: {found.blind_regret:.3f}), as "
            f"good as the expert's choice in {found.agreement:.0%}"
        )

    def _save(self, folder: Path, name: str) -> None:
        save_policy(folder, self.model, self.config.train_config(), self.observation, name)
