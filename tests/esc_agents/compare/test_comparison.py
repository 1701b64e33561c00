"""The whole of a small comparison, begun, broken, gone on with."""

import csv
import os
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from filelock import FileLock

from esc_agents.compare import store
from esc_agents.compare.comparison import choice, compare, dry_run, plan
from esc_agents.compare.grid import EPISODES, study_cells, train_config, tuning_cells
from esc_agents.config import config_for_env
from esc_agents.driving.checks import check
from esc_agents.driving.episodes import evaluate, model_policy
from esc_agents.driving.policies import load_policy
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError
from esc_agents.imitation.collect import collect
from esc_agents.imitation.imitate import open_imitation
from esc_agents.imitation.settings import CollectConfig
from esc_agents.training.train import train
from tests.esc_agents.compare.small import ENV, HereEngine, measured, small
from tests.esc_agents.tiny import ROAD

TASK = f"{ENV}-ppo"


def test_everything_is_there(compared):
    names = set(measured(compared))
    assert {cell.name for cell in study_cells(small())} < names
    assert {f"tuning {cell.name}" for cell in tuning_cells(small())} < names
    for name in ("report.html", "report.md", "summary.csv", "runs.csv", "command.txt"):
        assert (compared / name).stat().st_size > 0


def test_a_run_is_what_esc_train_makes_of_its_settings(compared, tmp_path):
    """Trained and evaluated by hand, against what the comparison found."""
    cell = next(c for c in study_cells(small()) if c.repr == "fp" and c.seed == 1)
    (result,) = [r for r in store.results(compared / TASK) if r.cell.name == "fp-s1"]
    settings = {**cell.__dict__, "candidate": result.cell.candidate}
    config = train_config(small(), type(cell)(**settings), 6)
    train(config.model_copy(update={"run_dir": tmp_path / "run"}))
    policy = load_policy(tmp_path / "run")[0]
    envs = vectorise(config, 1, evaluation=True)
    episodes = evaluate(envs, model_policy(policy), range(EPISODES, EPISODES + 3))
    assert result.drives[""] == episodes
    assert result.vehicles == result.slots == 6
    shuffled = vectorise(config, 1, evaluation=True, shuffle=True)
    again = evaluate(shuffled, model_policy(policy), range(EPISODES, EPISODES + 3))
    assert [e.seed for e in result.shuffled] == [e.seed for e in again]


def test_traffic_at_test_time_is_as_asked_for(compared):
    runs = {r.cell.name: r for r in store.results(compared / TASK)}
    assert set(runs["esc-s0"].drives) == {"", "more"}
    assert set(runs["esc-more-s0"].drives) == {"", "as it is"}
    assert (runs["esc-s0"].vehicles, runs["esc-more-s0"].vehicles) == (6, 9)
    more = [e.vehicles for e in runs["esc-s0"].drives["more"]]
    assert sum(more) > sum(e.vehicles for e in runs["esc-s0"].drives[""])


def test_the_best_candidate_is_taken(compared):
    planned = plan(small())
    for result in store.results(compared / TASK):
        tuned = [t for t in store.tuned(compared / TASK) if t.cell.repr == result.cell.repr]
        best = max(sum(t.returns) / len(t.returns) for t in tuned)
        chosen = choice(planned, result.cell, compared)
        assert result.cell.candidate == chosen
        assert best in [
            sum(t.returns) / len(t.returns) for t in tuned if t.cell.candidate == chosen
        ]


def test_what_is_finished_is_not_done_again(own, capsys):
    before = {path: path.stat().st_mtime_ns for path in (own / TASK / "results").iterdir()}
    engine = HereEngine()
    compare(small(), own, engine)
    assert engine.names == []
    assert "6 runs, 6 of them finished" in capsys.readouterr().out
    assert {path: path.stat().st_mtime_ns for path in before} == before


def test_more_is_added_to_what_there_is(own):
    engine = HereEngine()
    compare(small(repr=("esc", "fp", "mean"), seeds=3), own, engine)
    tuned = {name for name in engine.names if "tuning" in name}
    assert tuned == {f"{TASK}/tuning/mean-lr1-x{scale}-s1000" for scale in ("1", "0.1")}
    assert set(engine.names) - tuned == {
        f"{TASK}/{name}"
        for name in ("esc-s2", "fp-s2", "mean-s0", "mean-s1", "mean-s2", "mean-more-s0")
    }


def test_a_lost_result_is_measured_again_without_training(own, compared):
    (own / TASK / "results" / "esc-s1.json").unlink()
    policy = own / TASK / "runs" / "esc-s1" / "policy.safetensors"
    before = policy.stat().st_mtime_ns
    compare(small(), own, HereEngine())
    assert policy.stat().st_mtime_ns == before
    assert measured(own) == measured(compared)


def test_finished_runs_keep_their_policy_but_no_checkpoints(compared):
    runs = [path for path in (compared / TASK / "runs").iterdir() if path.is_dir()]
    assert len(runs) == 10  # 2 representations: 2 candidates each, 2 seeds, 1 in other traffic
    for folder in runs:
        assert (folder / "policy.safetensors").exists()
        assert not (folder / "checkpoints").exists()


def test_a_damaged_result_is_named_and_nothing_is_trained(own):
    path = own / TASK / "results" / "fp-s0.json"
    path.write_text(path.read_text()[:-9])
    engine = HereEngine()
    with pytest.raises(UserError, match=r"fp-s0\.json.*remove it and start again"):
        compare(small(seeds=3), own, engine)
    assert engine.names == []


@pytest.mark.parametrize("broken", ["foreign", "policy"])
def test_a_broken_run_is_named_and_the_rest_is_kept(own, broken):
    folder = own / TASK / "runs" / "esc-s1"
    (own / TASK / "results" / "esc-s1.json").unlink()
    if broken == "foreign":
        shutil.rmtree(folder)
        folder.mkdir()
        (folder / "notes.txt").write_text("mine")
    else:
        (folder / "policy.safetensors").write_bytes(b"x")
    with pytest.raises(UserError, match=r"1 of 3 jobs failed, the rest is kept.*esc-s1"):
        compare(small(seeds=3), own, HereEngine())
    assert (folder / "notes.txt").exists() == (broken == "foreign")
    assert store.path_of(own, next(c for c in study_cells(small(seeds=3)) if c.seed == 2)).exists()


def test_what_is_left_of_a_run_that_never_began_is_in_nobodys_way(own, compared):
    (own / TASK / "results" / "esc-s1.json").unlink()
    folder = own / TASK / "runs" / "esc-s1"
    shutil.rmtree(folder)
    begun = folder.with_name(".esc-s1.1.tmp")
    (begun / "checkpoints").mkdir(parents=True)
    (begun / ".config.yaml.1.tmp").touch()
    compare(small(), own, HereEngine())
    assert measured(own) == measured(compared)
    assert not begun.exists()


def test_other_settings_are_refused(own):
    with pytest.raises(UserError, match=r"begun with steps=32, now asked for with 64"):
        compare(small(steps=64), own, HereEngine())
    with pytest.raises(UserError, match=r"begun with steps=32, now asked for with 64"):
        dry_run(small(steps=64), own, workers=1)


def test_slots_are_declared():
    assert plan(small(slots=4)).slots == {ENV: 4}
    n = (
        check(train_config(small(), study_cells(small())[0], 1))
        .observation_space["vehicles"]
        .shape[0]
    )
    assert plan(small()).slots == {ENV: n}
    assert plan(small(slots=99)).slots == {ENV: n}


@pytest.mark.parametrize(("env", "env_config"), [("two-way", {}), ("parking", {"duration": 1})])
def test_scenarios_with_a_rule_driver_and_without(env, env_config, tmp_path, monkeypatch, capsys):
    """two-way reads the ego's meta-actions; in parking there are no lanes."""
    monkeypatch.setattr("esc_agents.compare.report.films", lambda *_: [])
    train = {**small().train, "env_config": env_config}
    one = {"repr": ("esc",), "seeds": 1, "episodes": 1, "tuning": {"scales": (1.0,)}}
    compare(small(env=(env,), transfer={}, train=train, **one), tmp_path, HereEngine())
    rows = csv.DictReader((tmp_path / "summary.csv").read_text().splitlines())
    drivers = [row["driver"] for row in rows]
    assert "random" in drivers
    assert ("IDM/MOBIL" in drivers) == (env == "two-way")
    why = "IDM/MOBIL is missing: expected lanes to follow, got a parking lot."
    for said in (capsys.readouterr().out, (tmp_path / "report.md").read_text()):
        assert said.count(why) == (env == "parking")


SCRIPT = """
from pathlib import Path
from esc_agents.compare.comparison import compare
from esc_agents.compare.engines import LocalEngine
from tests.esc_agents.compare.small import small
if __name__ == "__main__":
    compare(small(), Path("out"), LocalEngine(2))
"""


@pytest.mark.slow
def test_a_killed_comparison_goes_on(compared, tmp_path):
    """Killed after its first run; its processes end with it; the second time equals one go."""
    (tmp_path / "script.py").write_text(SCRIPT)
    out, environment = tmp_path / "out", {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "script.py"]
    driver = subprocess.Popen(command, cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL)
    first = None
    try:
        while driver.poll() is None and first is None:
            time.sleep(0.02)
            first = next((out / TASK / "results").glob("*.json"), None)
    finally:
        driver.send_signal(signal.SIGKILL)
        driver.wait()
    assert first is not None
    before = first.stat().st_mtime_ns
    for lock in (out / TASK / "runs").glob("*/.lock"):
        with FileLock(lock, timeout=20):  # nobody is left in it
            pass
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, stdout=subprocess.DEVNULL)
    assert first.stat().st_mtime_ns == before
    assert measured(out) == measured(compared)


def test_learning_from_a_data_set_of_each_scenario(tmp_path, monkeypatch):
    """Regret against the number of labels, for all of the same."""
    monkeypatch.chdir(tmp_path)
    changed = {"perception_distance": 200}
    observation = config_for_env(ENV).observation.model_copy(update=changed)
    gathered = CollectConfig(
        env=ENV, episodes=20, env_config=ROAD, planner={"horizon": 2, "free": 1},
        observation=observation,
    )  # fmt: skip
    collect(gathered, tmp_path / "data" / f"{ENV}-planner-v0")
    config = small(
        learn="imitate", seeds=2, transfer={}, tuning={"seeds": 0},
        imitate={"data": "data/{env}-planner-v0", "portions": 3, "epochs": 1},
        train={"env_config": ROAD, "observation": changed,
               "encoder": {"hidden": (8,), "code_dim": 200}},
    )  # fmt: skip
    denser = config.train | {"env_config": ROAD | {"vehicles_count": 9}}
    with pytest.raises(UserError, match=r"data .*: expected sets of up to N=9 vehicles, got N=6"):
        dry_run(config.model_copy(update={"train": denser}), tmp_path / "denser", workers=1)
    compare(config, tmp_path / "out", HereEngine())
    runs = store.results(tmp_path / "out" / f"{ENV}-imitation")
    labels = {tuple(run.curve["timesteps"]) for run in runs}
    (labels,) = labels
    report = (tmp_path / "out" / "report.md").read_text()
    assert f"**{ENV}, imitation**, {labels[-1]:,} labels, seeds 0, 1" in report
    header = " | ".join(f"{number:,} labels" for number in labels)
    assert f"| {header} |" in report
    for repr in ("esc", "fp"):
        last = [run.curve["regret"][-1] for run in runs if run.cell.repr == repr]
        named = [line for line in report.splitlines() if f"{ENV}, imitation: {repr} |" in line]
        (line,) = (one for one in named if one.count("|") == len(labels) + 2)
        assert f"{np.mean(last):.2f} [" in line.split("|")[-2]
    assert (tmp_path / "out" / "regret.png").stat().st_size > 5000


def test_learning_from_labels(tmp_path):
    """Runs of imitation, in a task of their own, beside those of the algorithm; begun again after
    a run that was killed, nothing is done twice."""
    train = {
        "env_config": ROAD, "encoder": {"hidden": (8,), "code_dim": 200},
        "observation": {"perception_distance": 200},
    }  # fmt: skip
    labelled = {"labels": 9, "rounds": 1, "epochs": 1, "planner": {"horizon": 2, "free": 1}}
    config = small(
        learn="imitate", imitate=labelled, train=train, seeds=1, transfer={}, tuning={"seeds": 0}
    )
    compare(config, tmp_path, engine := HereEngine())
    task = f"{ENV}-imitation"
    assert engine.names == [f"{task}/baselines", f"{task}/esc-s0", f"{task}/fp-s0"]
    found = {run.cell.repr: run for run in store.results(tmp_path / task)}
    assert [len(found[repr].curve["timesteps"]) for repr in ("esc", "fp")] == [2, 2]
    assert found["esc"].config["steps"] == 18
    folder = store.run_folder(tmp_path, found["esc"].cell)
    assert open_imitation(folder).planner.horizon == 2
    report = (tmp_path / "report.md").read_text()
    assert f"{ENV}, imitation: esc against fp" in report
    store.path_of(tmp_path, found["esc"].cell).unlink()
    compare(config, tmp_path, again := HereEngine())
    assert again.names == [f"{task}/esc-s0"]
    before = f"{tmp_path}/{{env}}-imitation/runs/{{repr}}-s{{seed}}"
    then = small(seeds=1, transfer={}, tuning={"seeds": 0}, repr=("fp",))
    then.train.update(start_from=before, ppo={**then.train["ppo"], "net_arch": (64, 64)})
    compare(then, tmp_path / "then", HereEngine())
    log = (tmp_path / "then" / f"{ENV}-ppo" / "runs" / "fp-s0.log").read_text()
    assert f"Beginning with the weights of {tmp_path}/{task}/runs/fp-s0" in log
    with pytest.raises(UserError, match="expected nothing but observation, encoder, env_config"):
        compare(small(learn="imitate"), tmp_path / "other", HereEngine())
    for wrong, message in [
        ({"imitate": {"label": 3}}, "imitate: unknown key 'label'; did you mean 'labels'"),
        ({"imitate": {"seed": 3}}, "imitate: seed: set by the comparison itself; leave it out"),
        ({"algo": "sac"}, "--learn imitate: expected --algo ppo, whose"),
    ]:
        asked = small(**{"learn": "imitate", "train": train, "transfer": {}, **wrong})
        with pytest.raises(UserError, match=message):
            compare(asked, tmp_path / "other", HereEngine())


LABELLED = {"env_config": ROAD}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"train": {"start_from": "no/{repr}-s{seed}"}},
            "fp-s0: expected a finished run in no/fp-s0$",
        ),
        (
            {"train": {"start_from": "no/s{seed}"}, "tuning": {}},
            "s1000: expected a finished run in no/s1000; tuning has seeds of its own",
        ),
        (
            {"learn": "imitate", "train": LABELLED, "imitate": {"planner": {"policy": "no/{env}"}}},
            f"fp-s0: expected a finished run in no/{ENV}$",
        ),
        (
            {"train": {"start_from": "no/{repr}-{ sed }"}},
            r"no/fp-\{ sed \}: expected \{env\}, \{repr\} or \{seed\}, got \{ sed \}",
        ),
        (
            {"learn": "imitate", "train": LABELLED, "imitate": {"data": "no-v0"}},
            "no data set in no-v0",
        ),
        ({"imitate": {"labels": 3}}, "imitate: expected --learn imitate beside it"),
    ],
)
def test_what_runs_begin_with_is_looked_for_before_anything_is_done(changes, message, tmp_path):
    asked = {"seeds": 1, "transfer": {}, "tuning": {"seeds": 0}, "repr": ("fp",), **changes}
    with pytest.raises(UserError, match=message):
        compare(small(**asked), tmp_path, HereEngine())
    with pytest.raises(UserError, match=message):
        dry_run(small(**asked), tmp_path, workers=1)
    assert not [path for path in tmp_path.rglob("*") if path.name != ".lock"]
