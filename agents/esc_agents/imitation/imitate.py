"""esc-imitate's work: a run directory whose policy was learned from an expert's labels.

<run>/imitate.yaml      what the run is, beside config.yaml, the same as a run of esc-train
      labels/*.npz      the labels of each round
      rounds/*          what the policy was after each round

A round follows from the seed and what the rounds before it left, and from nothing else: one that
was killed is done anew, and ends as it would have.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from esc_agents import files, strangers
from esc_agents.config import TrainConfig, dump, load
from esc_agents.driving.baselines import action_names
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check
from esc_agents.driving.environments import wrapper_json
from esc_agents.driving.episodes import Summary, model_policy, seeds
from esc_agents.driving.policies import load_policy, save_policy, start_from
from esc_agents.driving.vectorised import closing, vectorise
from esc_agents.errors import UserError, say
from esc_agents.imitation import datasets, labels
from esc_agents.imitation.experts import Expert, expert_of
from esc_agents.imitation.labels import Drive, Labels, split
from esc_agents.imitation.learning import fit, measure
from esc_agents.imitation.settings import ImitateConfig
from esc_agents.training import run_directory
from esc_agents.training.callbacks import (
    FixedSeedEvaluation,
    MetricsWriter,
    StopOnSignal,
    Stopped,
)
from esc_agents.training.models import describe, new_model
from esc_agents.training.results import finish, results, rule_summary
from esc_agents.training.run_directory import IMITATE


def imitate(
    config: ImitateConfig, resume: Path | None = None, trust: bool = False,
    told: Callable[[int], object] = lambda labels: None,
) -> bool:  # fmt: skip
    """Learn as ``config`` says; prints the results. False where a signal ended it early.

    resume: an existing run directory, which goes on after its last whole round. trust: also load
    what others wrote and can run their code. told: called after each round, with how many labels
    there are.
    """
    run = config.train_config()
    directory = resume or run.run_dir or run_directory.default_run_dir(run, "imitation")
    if resume is None:
        run_directory.check_free(directory)
    elif run_directory.finished(resume):
        raise UserError(
            f"{resume} is finished: there is nothing to continue; PPO goes on from it with "
            f"esc-train --start-from {resume}"
        )
    probe: Any = check(run)
    expert, given = _labellers(config, run, probe, trust)
    with run_directory.said(directory, "esc-imitate"), ExitStack() as stack:
        envs: Any = stack.enter_context(closing(BatchVecEnv(run, run.n_envs, evaluation=True)))
        count = min(run.n_envs, run.evaluation.episodes)
        judges = stack.enter_context(closing(vectorise(run, count, evaluation=True)))
        model: Any = new_model(run, envs)
        if config.start_from:
            start_from(model.policy, config.start_from, run.algo, wrapper_json(probe), trust)
        if resume is None:
            signed = strangers.signed(f"# mac: {strangers.BLANK}\n{dump(config)}")
            texts = {IMITATE: signed}
            run_directory.create(directory, run, wrapper_json(probe), str(model.device), texts)
        stack.enter_context(run_directory.locked(directory))
        if resume:
            run_directory.note_command(resume)
        stop = stack.enter_context(StopOnSignal())
        say(describe(run, model, probe))
        rounds = config.portions + config.dagger_rounds
        say(f"{rounds} round{'s' * (rounds > 1)} into {directory}")
        rule = rule_summary(run, stop)
        learning = Imitation(
            config, run, directory, model, wrapper_json(probe), judges, stop, rule, told, trust
        )
        try:
            learning.learn(envs, expert, given)
        except Stopped:
            pass
        else:
            policy, names = model_policy(model), action_names(probe)
            found = results(run, policy, judges, names, rule, stop)
            if not stop():
                finish(run, directory, found, model.num_timesteps)
                return True
        say(f"Stopped; continue with: esc-imitate --resume {directory}")
        return False


def open_imitation(directory: Path, trust: bool = False) -> ImitateConfig:
    """What a run of esc-imitate is. Raises UserError where ``directory`` holds none."""
    if not (directory / IMITATE).is_file():
        raise UserError(
            f"{directory} is no run of esc-imitate: expected {IMITATE} in it; esc-train --resume "
            "continues those of esc-train"
        )
    return load(directory / IMITATE, "imitate", ImitateConfig, trust)


def _labellers(
    config: ImitateConfig, run: TrainConfig, probe: Any, trust: bool
) -> tuple[Expert | None, list[Drive] | None]:
    """(who labels, what is labelled already). Raises UserError where there is not enough of it."""
    if (config.expert, config.data) == (None, None):
        raise UserError("expected --expert NAME, who labels, or --data DIR, of esc-collect")
    if config.portions > 1 and not config.data:
        raise UserError("portions: expected --data DIR, of which they are")
    if config.dagger_rounds and not config.expert:
        raise UserError("rounds: expected --expert, who labels what the learner meets")
    expert = given = None
    if config.expert:
        expert = expert_of(config.expert, config.planner, run, trust, free=1)
    if config.data:
        given = read_data(config.data, run, probe)
    return expert, given


def read_data(path: Path, run: TrainConfig, probe: Any) -> list[Drive]:
    """What a run learns from. probe: one of its environments. Raises UserError as ``read``."""
    return datasets.read(path, wrapper_json(probe), int(getattr(probe.action_space, "n", 0)), run)


@dataclass
class Imitation:
    """The rounds of a run; those that an earlier session has finished are taken from the disk.

    observation: of ``wrapper_json``. judges: environments for evaluation. rule: how IDM/MOBIL drive
    there. told, trust: as of ``imitate``.
    """

    config: ImitateConfig
    run: TrainConfig
    directory: Path
    model: Any
    observation: dict[str, Any]
    judges: VecEnv
    stop: StopOnSignal
    rule: Summary | None
    told: Callable[[int], object]
    trust: bool
    drives: list[Drive] = field(default_factory=list)
    _evaluation: FixedSeedEvaluation | None = None

    def learn(self, envs: BatchVecEnv, expert: Expert | None, given: list[Drive] | None) -> None:
        """Do all rounds, and write the policy; raises Stopped where a signal ends it early.

        given: the labels of the first round.
        """
        portions, policy = self.config.portions, self.model.policy
        untrained = deepcopy(policy.state_dict())
        for number in range(portions + self.config.dagger_rounds):
            if given and number < portions:
                self.drives = given[: -(-len(given) // 2 ** (portions - 1 - number))]
                policy.load_state_dict(untrained)
            else:
                self.drives += self._labelled(number, envs, expert)
            if not self._done(number):
                self._learned(number, given if number < portions and given else self.drives)
            self.told(self.model.num_timesteps)
        self._check()
        files.write_atomically(self.directory / "model.zip", self.model.save)
        self._save(self.directory, "policy")

    def _check(self) -> None:
        if self.stop():
            raise Stopped

    def _labelled(self, number: int, envs: BatchVecEnv, expert: Any) -> list[Drive]:
        """Episodes of a round, to the end of the one with the last label."""
        config, path = self.config, self.directory / "labels" / f"{number:03d}.npz"
        if path.exists():
            return labels.load(path)
        driver = model_policy(self.model) if number else None
        noise = 0.0 if number else config.noise
        generator = np.random.default_rng([config.seed, number])
        first = int(generator.integers(10**7, 2**31))  # far above those of evaluations
        drives: list[Drive] = []
        # Two at least, since one is held out.
        while len(drives) < 2 or sum(len(drive.actions) for drive in drives) < config.labels:
            chosen = range(first + len(drives), first + len(drives) + envs.num_envs)
            drives += labels.collect(envs, chosen, expert, driver, noise, generator, self.stop)
            self._check()
        path.parent.mkdir(exist_ok=True)
        labels.save(path, drives)
        mean = np.mean([drive.rewards.sum() for drive in drives])
        who = "the learner drove" if number else f"{config.expert} drove, noise {noise:g}"
        say(f"round {number}: {who}: {len(drives):,} episodes, mean return {mean:.2f}")
        return drives

    def _done(self, number: int) -> bool:
        """Whether an earlier session has finished a round; its policy is taken."""
        if not (self.directory / "rounds" / f"{number:03d}.json").exists():
            return False
        folder = self.directory / "rounds"
        policy, steps = load_policy(folder, "cpu", f"{number:03d}", self.trust)
        self.model.policy.load_state_dict(policy.state_dict())
        self.model.num_timesteps = steps
        return True

    def _learned(self, number: int, held: list[Drive]) -> None:
        """Train the policy on all labels so far, and see how it drives, and what it makes of those
        that are held out of ``held``."""
        evaluation = self._evaluation = self._evaluation or self._begun()
        model = self.model
        model.num_timesteps = sum(len(drive.actions) for drive in self.drives)
        apart = split(held)[1]
        learnt = Labels.of([drive for drive in self.drives if not any(d is drive for d in apart)])
        held_out = Labels.of(apart)
        loss = fit(model.policy, learnt, self.config, number, self.stop)
        self._check()
        found = measure(model.policy, held_out)
        say(
            f"round {number}: {len(learnt):,} labels, regret {found.regret:.3f} on "
            f"{len(held_out):,} held out (always the same action: {found.blind_regret:.3f}), as "
            f"good as the expert's choice in {found.agreement:.0%}"
        )
        for key, value in {**asdict(found), "loss": loss}.items():
            model.logger.record(f"imitation/{key}", value)
        evaluation.judge()
        model.logger.dump(model.num_timesteps)
        (self.directory / "rounds").mkdir(exist_ok=True)
        self._save(self.directory / "rounds", f"{number:03d}")

    def _begun(self) -> FixedSeedEvaluation:
        """What notes how rounds end, after those that are done."""
        metrics = MetricsWriter(self.directory / "metrics.csv", self.model.num_timesteps)
        self.model.set_logger(Logger(str(self.directory), [metrics]))
        evaluation = FixedSeedEvaluation(self.judges, seeds(self.run), 1, self.directory)
        evaluation.stopped, evaluation.rule = self.stop, self.rule
        evaluation.save_best = partial(self._save, self.directory, "best_policy")
        evaluation.init_callback(self.model)
        return evaluation

    def _save(self, folder: Path, name: str) -> None:
        save_policy(folder, self.model, self.run, self.observation, name)
