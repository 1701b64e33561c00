"""The search: what is tried, what is kept, and that a search that was stopped goes on."""

from __future__ import annotations

import sys
from shutil import copytree

import numpy as np
import pytest
import yaml

from esc_agents.cli.tune import command
from esc_agents.compare.jobs import Interrupted
from esc_agents.config import load_config, shipped
from esc_agents.driving.environments import in_training
from esc_agents.errors import UserError
from esc_agents.training.run_directory import read_evaluations
from esc_agents.tuning import trials
from esc_agents.tuning.search import as_known, choose, distributions
from esc_agents.tuning.settings import TuneConfig, train_config
from esc_agents.tuning.trials import SPARED, TrialJob, Tried, bars
from esc_agents.tuning.tune import tune
from tests.esc_agents.tiny import PPO, ROAD

SPACE = {
    "ppo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True},
    "ppo.n_epochs": {"low": 1, "high": 2},
    "ppo.net_arch": {"choices": [[4], [8]]},
}
SMALL = TuneConfig(
    env="highway-fast-v0", trials=3, round=2, steps=320, finalists=1, seeds=1, space=SPACE,
    train={
        "env_config": ROAD, "n_envs": 2, "vec": "dummy", "steps": 64, "ppo": PPO,
        "encoder": {"hidden": [8], "code_dim": 200}, "evaluation": {"episodes": 1},
    },
)  # fmt: skip


class Here:
    """Runs jobs in this process, until as many as ``patience`` were begun."""

    def __init__(self, patience=1000):
        self.patience, self.begun = patience, []

    def run(self, jobs, out, done, post):
        for job in jobs:
            if len(self.begun) == self.patience:
                done(job, Interrupted())
                continue
            self.begun.append(job.name)
            job.do(out, post)
            done(job, None)


def found(out):
    paths = [*sorted((out / "trials").iterdir()), *sorted((out / "finals").iterdir())]
    return {
        path.name: (t.parameters, t.returns, t.pruned) for path in paths if (t := trials.read(path))
    }


def tried(number, returns, parameters=None, **changes):
    values = {"seed": 0, "pruned": False, "problem": "", "seconds": 1.0, "made_with": {}, **changes}
    return Tried(
        number, parameters or {}, timesteps=list(range(len(returns))), returns=returns,
        crashed=[0.0] * len(returns), **values,
    )  # fmt: skip


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    out = tmp_path_factory.mktemp("search") / "out"
    tune(SMALL, out, Here())
    return out


def test_a_search(whole, capsys):
    results = found(whole)
    assert [name for name in results] == [
        "000.json", "001.json", "002.json", "000-s0.json", *sorted(
            name for name in results if name.endswith("-s0.json") and not name.startswith("000"))
    ]  # fmt: skip
    assert results["000.json"][0] == {}  # the scenario as it is
    for number in (1, 2):
        parameters = results[f"{number:03d}.json"][0]
        assert set(parameters) == set(SPACE)
        assert 1e-4 <= parameters["ppo.learning_rate"] <= 1e-2
        assert parameters["ppo.n_epochs"] in (1, 2)
        assert parameters["ppo.net_arch"] in ([4], [8])
    best = load_config(whole / "best.yaml")
    assert (best.env, best.steps, best.seed) == ("highway-fast-v0", 64, 0)
    text = (whole / "README.md").read_text()
    assert "Trial 0 is the scenario as it is shipped" in text
    assert "ppo.learning_rate" in text


@pytest.mark.parametrize("patience", [0, 1, 2, 3])
def test_stopped_and_begun_again(whole, patience, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        tune(SMALL, tmp_path / "out", Here(patience))
    tune(SMALL, tmp_path / "out", Here())
    assert found(tmp_path / "out") == found(whole)


def test_nothing_is_done_twice(whole):
    engine = Here()
    tune(SMALL, whole, engine)
    assert not engine.begun


def test_the_same_is_chosen_of_the_same():
    one, other = (
        [as_known(SMALL, choose(SMALL, [], 2)[1], value, [value])] for value in (1.0, 1.0)
    )
    assert choose(SMALL, one, 4) == choose(SMALL, other, 4)
    assert choose(SMALL, [], 3)[0] == {}
    reseeded = SMALL.model_copy(update={"seed": 1})
    assert choose(reseeded, one, 4) != choose(SMALL, one, 4)


def test_what_is_known_leads_the_search():
    """Of settings that were much better, more of the kind are tried."""
    config = SMALL.model_copy(update={"space": {"ppo.gamma": {"low": 0.0, "high": 0.99}}})
    rng, known = np.random.default_rng(0), []
    for gamma in rng.uniform(0, 0.99, 40).tolist():
        value = -abs(gamma - 0.3)
        known.append(as_known(config, {"ppo.gamma": gamma}, value, [value]))
    gammas = [parameters["ppo.gamma"] for parameters in choose(config, known, 20)]
    assert np.mean(np.abs(np.array(gammas) - 0.3) < 0.15) > 0.6  # by chance 0.3


def test_bars_are_medians_of_the_best_so_far():
    runs = [tried(i, [i, 10 - i, 0.0]) for i in range(5)]
    assert bars(runs[:3]) == ()
    assert bars(runs) == (2.0, 8.0, 8.0)
    early = tried(9, [100.0], pruned=True)
    assert bars([*runs, early]) == bars(runs)


def test_a_run_below_the_bar_is_ended(tmp_path):
    job = TrialJob(SMALL, 7, {}, None, (np.inf,) * 10)
    job.do(tmp_path, lambda progress: None)
    found = trials.read(job.files(tmp_path)[1])
    assert found
    assert (found.pruned, found.value, len(found.returns)) == (True, None, SPARED + 1)
    saved = read_evaluations(tmp_path / "runs" / "trials-007" / "evaluations.npz")
    assert found.returns == saved["results"].mean(axis=1).tolist()


def test_a_finished_run_of_other_settings_is_not_taken(whole, tmp_path):
    copytree(whole / "runs", tmp_path / "runs")
    before = trials.read(trials.path_of(whole, 1))
    assert before
    changed = {**before.parameters, "ppo.learning_rate": 0.5}
    with pytest.raises(UserError, match="trained with other settings; remove it"):
        TrialJob(SMALL, 1, changed).do(tmp_path, print)
    assert not trials.path_of(tmp_path, 1).exists()


def test_what_is_searched_in_the_scenario_is_also_in_training():
    config = SMALL.model_copy(update={"env": "highway-dense", "train": {}})
    run = train_config(config, {"env_config.collision_reward": -8}, 0)
    assert {c.env_config["collision_reward"] for c in (run, in_training(run))} == {-8}


def test_settings_that_cannot_be_trained_with(tmp_path):
    space = {"ppo.batch_size": {"choices": [4096]}}
    config = SMALL.model_copy(update={"space": space, "trials": 2, "finalists": 0})
    tune(config, tmp_path / "out", Here())
    found = trials.read(tmp_path / "out" / "trials" / "001.json")
    assert found
    assert "ppo.batch_size: expected at most n_steps * n_envs = 32, got 4096" in found.problem


def test_another_search_in_the_same_directory(whole):
    other = SMALL.model_copy(update={"seed": 5})
    with pytest.raises(
        UserError, match="holds a search with seed 0, got 5; take another directory"
    ):
        tune(other, whole, Here())


def test_a_damaged_trial_is_named(whole, tmp_path):
    path = tmp_path / "trials" / "000.json"
    path.parent.mkdir()
    path.write_bytes((whole / "trials" / "000.json").read_bytes()[:-9])
    with pytest.raises(UserError, match=r"000\.json.*remove it, and it is made anew"):
        trials.read(path)


@pytest.mark.parametrize(
    ("space", "message"),
    [
        ({}, "space: expected at least one key"),
        ({"ppo.gama": {"choices": [0.9]}}, "unknown key 'ppo.gama'; did you mean 'gamma'"),
        ({"ppo.gamma": {"choices": [7]}}, "less than or equal to 1"),
        ({"ppo.gamma": [0.9]}, "ppo.gamma: expected {low: 1e-4, high: 1e-2, log: true} or"),
        ({"ppo.gamma": {"low": 0.9}}, "ppo.gamma: expected {low: 1e-4"),
        ({"ppo.gamma": {"low": 0.9, "high": 0.1}}, "ppo.gamma: expected {low: 1e-4"),
        ({"seed": {"choices": [1]}}, "seed: set by the search itself; leave it out"),
    ],
)
def test_bad_spaces(space, message):
    with pytest.raises(UserError) as raised:
        distributions(SMALL.model_copy(update={"space": space}))
    assert message in str(raised.value)


@pytest.mark.parametrize("name", shipped("tune"))
def test_shipped_searches(name):
    values = yaml.safe_load(shipped("tune")[name].read_text())
    values.pop("schema")
    config = TuneConfig(**values)
    assert distributions(config)
    assert train_config(config, {}, 0).algo == config.algo


def test_without_optuna(monkeypatch, tmp_path):
    for module in ("tune", "search", "report"):
        monkeypatch.delitem(sys.modules, f"esc_agents.tuning.{module}")
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(UserError, match=r"pip install 'esc-gym\[tune\]'"):
        command(["--config", "ppo", "--out", str(tmp_path / "out")])
    assert not (tmp_path / "out").exists()
