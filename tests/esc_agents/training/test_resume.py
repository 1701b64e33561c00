"""A run that was killed and resumed ends as one that was not, bit for bit."""

from __future__ import annotations

import pkgutil
import signal

import numpy as np
import pytest

from esc_agents.driving.crash_replay import CrashReplay
from esc_agents.driving.environments import make_env
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError
from esc_agents.training import callbacks, run_directory
from esc_agents.training.checkpoint import in_order
from esc_agents.training.models import ALGORITHMS
from esc_agents.training.train import train
from tests.esc_agents.tiny import tiny

SAME = (
    "policy.safetensors", "best_policy.safetensors", "metrics.csv", "evaluations.npz",
    "results.json",
)  # fmt: skip


def config(algo, n_envs=2, **changes):
    """A run of ten rollouts, or of four logged episodes; with random numbers everywhere."""
    if algo == "ppo":
        return tiny(
            algo="ppo", n_envs=n_envs, steps=160 * n_envs // 2, checkpoint_every=20,
            evaluation={"episodes": 2, "every": 48}, repr="ap", **changes,
        )  # fmt: skip
    return tiny(
        algo="sac", n_envs=n_envs, steps=120, checkpoint_every=30, repr="ap",
        evaluation={"episodes": 2, "every": 48}, sac={**tiny().sac.model_dump(), "train_freq": 1},
        continuous={"env_config": {"action": {"type": "ContinuousAction"}}}, **changes,
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Uninterrupted runs by what they are of."""
    made = {}

    def get(algo, **changes):
        key = (algo, *sorted(changes.items()))
        if key not in made:
            made[key] = tmp_path_factory.mktemp("whole") / "run"
            assert train(config(algo, run_dir=made[key], **changes))
        return made[key]

    return get


class Killed(BaseException):
    """Stands for SIGKILL: nothing between it and the test handles it."""


def kill(monkeypatch, owner, name, call):
    """Let the ``call``-th call of a function end the process."""
    original, calls = getattr(owner, name), []

    def dying(*args, **kwargs):
        calls.append(None)
        if len(calls) == call:
            raise Killed
        return original(*args, **kwargs)

    monkeypatch.setattr(owner, name, dying)


def assert_same(one, two):
    for name in SAME:
        assert (one / name).read_bytes() == (two / name).read_bytes(), name


MOMENTS = {
    "in a rollout": ("esc_agents.training.callbacks.DrivingLog._on_step", 43),
    "in an evaluation": ("esc_agents.driving.episodes._episode", 4),
    "in a checkpoint": ("esc_agents.training.checkpoint.capture", 4),
    "before the first evaluation": ("esc_agents.training.callbacks.DrivingLog._on_step", 21),
    "in the final evaluation": ("esc_agents.training.results.blind_policies", 1),
}


@pytest.mark.parametrize("algo", ["ppo", "sac"])
@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("vec", ["dummy", "batch"])
def test_killed_and_resumed(vec, algo, moment, whole, tmp_path, monkeypatch):
    """In the batch engine too, whose runs end as those of environments one by one."""
    path, call = MOMENTS[moment]
    owner, _, name = path.rpartition(".")
    kill(monkeypatch, pkgutil.resolve_name(owner), name, call)
    with pytest.raises(Killed):
        train(config(algo, vec=vec, run_dir=tmp_path / "run"))
    monkeypatch.undo()
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    assert_same(whole(algo), tmp_path / "run")


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_exploring_with_a_noise_that_lasts(algo, tmp_path, monkeypatch):
    """gSDE, its policy's own weights among those of the two files that hold no code."""
    settings = getattr(tiny(), algo).model_dump() | {"use_sde": True, "sde_sample_freq": 4}
    run = tiny("lane-keeping-v0", algo=algo, steps=80, checkpoint_every=20, **{algo: settings})
    assert train(run.model_copy(update={"run_dir": tmp_path / "whole"}))
    kill(monkeypatch, callbacks.DrivingLog, "_on_step", 31)
    with pytest.raises(Killed):
        train(run.model_copy(update={"run_dir": tmp_path / "run"}))
    monkeypatch.undo()
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    assert_same(tmp_path / "whole", tmp_path / "run")
    observation, _ = make_env(run).reset(seed=0)
    model = ALGORITHMS[algo].load(tmp_path / "run" / "model.zip")
    assert (model.use_sde, model.sde_sample_freq) == (True, 4)
    np.testing.assert_array_equal(
        load_policy(tmp_path / "run")[0].predict(observation, deterministic=True)[0],
        model.predict(observation, deterministic=True)[0],
    )


def test_with_collisions_that_are_replayed(tmp_path, monkeypatch):
    road = {"vehicles_count": 20, "lanes_count": 1, "policy_frequency": 5}
    settings = tiny().ppo.model_dump() | {"crash_replay": 0.5}
    run = tiny(vec="batch", steps=640, checkpoint_every=100, env_config=road, ppo=settings)
    begun, begin = [], CrashReplay.begin

    def noted(self, chosen):
        begun.append(begin(self, chosen))
        return begun[-1]

    monkeypatch.setattr(CrashReplay, "begin", noted)
    assert train(run.model_copy(update={"run_dir": tmp_path / "whole"}))
    before = np.sum(begun)
    kill(monkeypatch, callbacks.DrivingLog, "_on_step", 250)
    with pytest.raises(Killed):
        train(run.model_copy(update={"run_dir": tmp_path / "run"}))
    monkeypatch.setattr(CrashReplay, "begin", noted)
    begun.clear()
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    assert before > np.sum(begun) > 0
    assert_same(tmp_path / "whole", tmp_path / "run")


def test_a_checkpoint_of_the_other_kind(own_run):
    """Written by environments one by one, read by a batch."""
    config = run_directory.open_run(own_run).model_copy(update={"steps": 64, "vec": "batch"})
    with pytest.raises(UserError, match="were simulated as objects, which they are not here"):
        train(config, resume=own_run)


@pytest.mark.parametrize("algo", ["ppo", "sac"])
@pytest.mark.parametrize("n_envs", [1, 4])
def test_the_same_command_twice(algo, n_envs, whole, tmp_path):
    assert train(config(algo, n_envs=n_envs, run_dir=tmp_path / "run"))
    assert_same(whole(algo, n_envs=n_envs), tmp_path / "run")


@pytest.mark.slow
def test_with_environments_in_processes(whole, tmp_path, monkeypatch):
    kill(monkeypatch, callbacks.DrivingLog, "_on_step", 43)
    with pytest.raises(Killed):
        train(config("ppo", vec="subproc", run_dir=tmp_path / "run"))
    monkeypatch.undo()
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    assert_same(whole("ppo"), tmp_path / "run")


@pytest.mark.parametrize("algo", ["ppo", "sac"])
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopped_by_a_signal_and_resumed(algo, number, whole, tmp_path, monkeypatch):
    def interrupt(self):
        if self.num_timesteps == 100:
            signal.raise_signal(number)
        return log(self)

    log = callbacks.DrivingLog._on_step
    monkeypatch.setattr(callbacks.DrivingLog, "_on_step", interrupt)
    assert not train(config(algo, run_dir=tmp_path / "run"))
    monkeypatch.undo()
    steps = int(in_order(tmp_path / "run" / "checkpoints")[-1].stem)
    assert 100 <= steps < 100 + 32  # nothing is lost but the wait for the end of the rollout
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    assert_same(whole(algo), tmp_path / "run")


def test_a_damaged_checkpoint_is_passed_over(whole, tmp_path, monkeypatch, capsys):
    kill(monkeypatch, callbacks.DrivingLog, "_on_step", 60)
    with pytest.raises(Killed):
        train(config("ppo", run_dir=tmp_path / "run"))
    monkeypatch.undo()
    before, last = in_order(tmp_path / "run" / "checkpoints")
    last.write_bytes(last.read_bytes()[:-100])
    assert train(run_directory.open_run(tmp_path / "run"), resume=tmp_path / "run")
    printed = capsys.readouterr().out
    assert f"{last} is cut off" in printed
    assert f"Continuing from {before}" in printed
    assert_same(whole("ppo"), tmp_path / "run")


def test_no_whole_checkpoint(own_run):
    for path in in_order(own_run / "checkpoints"):
        path.write_bytes(b"nothing")
    with pytest.raises(UserError, match="holds no whole checkpoint; start it anew"):
        train(run_directory.open_run(own_run).model_copy(update={"steps": 64}), resume=own_run)


def test_metrics_have_neither_gap_nor_repeat(whole):
    rows = (whole("ppo") / "metrics.csv").read_text().splitlines()[1:]
    steps = [int(row.partition(",")[0]) for row in rows]
    assert steps == sorted(set(steps))
    assert steps[-1] == 160


@pytest.fixture
def stopped_at_20(monkeypatch):
    def interrupt(self):
        if self.num_timesteps == 20:
            signal.raise_signal(signal.SIGINT)
        return True

    with monkeypatch.context() as patched:
        patched.setattr(callbacks.DrivingLog, "_on_step", interrupt)
        yield patched


def test_fewer_steps_than_an_unfinished_run_has_are_refused(tmp_path, stopped_at_20):
    """Its training would be done without a word, and config.yaml would say what is not so."""
    run = tmp_path / "run"
    assert not train(tiny(steps=96, run_dir=run, evaluation={"episodes": 1, "every": 64}))
    stopped_at_20.undo()
    begun = run_directory.open_run(run)
    with pytest.raises(UserError, match="has 32 of 16 steps already; ask for more with --steps"):
        train(begun.model_copy(update={"steps": 16}), resume=run)
    assert run_directory.open_run(run).steps == 96
    assert train(begun.model_copy(update={"steps": 64}), resume=run)


def test_where_a_run_that_was_stopped_in_an_evaluation_goes_on(tmp_path, stopped_at_20, capsys):
    """Which is at step 32, in the midst of a rollout's callbacks."""
    assert not train(tiny(steps=96, run_dir=tmp_path / "run"))
    printed = capsys.readouterr().out
    assert "Stopped after 32 steps; the model is saved. From step 0 on it is done again." in printed
