"""The best agents of a comparison become the zoo, with a page and a card for each."""

from __future__ import annotations

import shlex
from dataclasses import replace

import numpy as np
import pytest

from esc_agents import pretrained, zoo
from esc_agents.cli import keep as keep_cli, train as train_cli
from esc_agents.compare import store
from esc_agents.compare.analysis import load
from esc_agents.compare.comparison import compare
from esc_agents.driving.policies import load_policy
from esc_agents.training import train as training
from esc_agents.zoo.keeping import best_of
from esc_agents.zoo.report import above, command, learned, steps
from tests.esc_agents.compare.small import ENV, HereEngine, small


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    out = tmp_path_factory.mktemp("zoo") / "compared"
    # Networks so small cannot be equally large.
    unmatched = {"hidden": (8,), "code_dim": 200, "match_parameters": False}
    train = {**small().train, "encoder": unmatched}
    grid = small(repr=("esc", "attention"), tuning={"seeds": 0}, transfer={}, train=train)
    compare(grid, out, HereEngine())
    return out


@pytest.fixture(autouse=True)
def own_zoo(tmp_path, monkeypatch):
    monkeypatch.setattr(pretrained, "folder", lambda: tmp_path / "zoo")


def test_a_comparison_is_published(compared, call, tmp_path):
    code, out, _ = call(keep_cli, compared, "--docs", "docs")
    assert code == 0
    assert ENV in out
    (agent, *rest) = best_of(compared)
    assert zoo.names() == sorted([ENV, *(other.name for other in rest)])
    page = (tmp_path / "docs" / "zoo.md").read_text()
    assert f"| {ENV} |" in page
    assert "| 2 x 3 |" in page
    made_by = (compared / "command.txt").read_text().splitlines()[0]
    assert f"- `{made_by}`" in page
    assert (tmp_path / "docs" / "zoo" / f"{ENV}.gif").read_bytes()[:6] == b"GIF89a"
    assert page.count("esc-gym: ") == 1  # all runs had the same versions
    config = (tmp_path / "zoo" / ENV / "config.yaml").read_text()
    assert config.startswith(f"# esc-train --config zoo/{ENV}/config.yaml\n")
    card = (tmp_path / "zoo" / ENV / "README.md").read_text()
    assert f"Drives `{ENV}`" in card
    assert f"Trained and evaluated by: `{made_by}`; seed" in card
    # What is kept is the run that was best in training.
    runs = {run.cell.seed: np.mean(run.curve["results"][-3:]) for run in agent.runs}
    assert agent.chosen.cell.seed == max(runs, key=lambda seed: runs[seed])
    kept, _ = load_policy(tmp_path / "zoo" / ENV)
    expected, _ = load_policy(store.run_folder(compared, agent.chosen.cell))
    for one, other in zip(kept.parameters(), expected.parameters(), strict=True):
        assert (one == other).all()


def test_the_rival_is_kept_only_where_it_is_better(compared, monkeypatch):
    (task,) = load(compared)

    def shifted(by):
        results = [
            run if run.cell.repr == "esc" else replace(run, drives={
                "": [replace(e, reward=e.reward + by) for e in run.drives[""]]
            })
            for run in task.results
        ]  # fmt: skip
        monkeypatch.setattr(
            "esc_agents.zoo.keeping.load", lambda out: [replace(task, results=results)]
        )
        return [agent.name for agent in best_of(compared)]

    assert shifted(100.0) == [ENV, f"{ENV}-attention"]
    assert shifted(-100.0) == [ENV]


def test_a_rival_that_is_no_longer_better_leaves(compared, tmp_path, monkeypatch, call):
    ours = best_of(compared)[:1]
    rival = replace(ours[0], name=f"{ENV}-attention")
    for agents, expected in (([*ours, rival], [ENV, rival.name]), (ours, [ENV])):
        monkeypatch.setattr("esc_agents.zoo.report.best_of", lambda out, found=agents: found)
        assert call(keep_cli, compared, "--docs", "docs")[0] == 0
        assert zoo.names() == expected
        assert sorted(p.stem for p in (tmp_path / "docs" / "zoo").glob("*.gif")) == expected
        assert ("-attention |" in (tmp_path / "docs" / "zoo.md").read_text()) == (
            len(expected) == 2
        )


def test_a_rival_that_was_not_compared_stays(compared, tmp_path, call):
    other = tmp_path / "zoo" / f"{ENV}-esc-exp"
    other.mkdir(parents=True)
    assert call(keep_cli, compared, "--docs", "docs")[0] == 0
    assert other.is_dir()


def test_above_both_is_above_all(compared):
    (agent, *_) = best_of(compared)

    def beside(blind, rule):
        """Others with these upper ends of their intervals, ours from 1 on."""
        own = [replace(run, drives={"": [replace(e, reward=1.0) for e in run.drives[""]]})
               for run in agent.runs]  # fmt: skip
        one = agent.task.baselines.rule
        assert one
        blinds = {"idle": replace(one, reward=0.0, reward_high=blind)}
        rules = None if rule is None else replace(one, reward=0.0, reward_high=rule)
        baselines = replace(agent.task.baselines, blind=blinds, rule=rules)
        return above(replace(agent, runs=own, task=replace(agent.task, baselines=baselines)))

    assert beside(0.9, 0.9)
    assert beside(0.9, None)
    assert not beside(1.1, 0.9)
    assert not beside(0.9, 1.1)


@pytest.mark.parametrize("name", [True, False])
def test_what_is_to_be_kept_has_to_be_clear(name, compared, ppo_run, call):
    """A comparison has no name, a run needs one."""
    arguments = [compared, "--name", "x"] if name else [ppo_run]
    code, _, err = call(keep_cli, *arguments)
    assert (code, err.count("\n")) == (2, 1)
    assert "expected the directory of a comparison, or that of a run and --name NAME" in err
    assert zoo.names() == []


def test_what_is_to_be_kept_has_to_be_there(call):
    code, _, err = call(keep_cli, "nowhere")
    assert (code, err.count("\n")) == (2, 1)
    assert "nowhere: expected a directory of esc-compare or esc-train" in err


def test_the_command_trains_the_agent_again(compared, monkeypatch):
    agent = best_of(compared)[0]
    assert learned(agent) == "trained with PPO for 32 steps"
    asked = []
    monkeypatch.setattr(training, "train", lambda config, **_: asked.append(config) or True)
    program, *words = shlex.split(command(agent))
    assert (program, train_cli.command(words)) == ("esc-train", 0)
    again, before = asked[0].model_dump(mode="json"), agent.chosen.config
    for name in before.keys() - {"evaluation", "run_dir", "device", "threads", "checkpoint_every"}:
        assert again[name] == before[name], name


def changed(agent, settings, **config):
    """The agent, had it been made with these settings of its comparison."""
    task = replace(agent.task, settings=agent.task.settings | settings)
    chosen = replace(agent.chosen, config=agent.chosen.config | config)
    return replace(agent, task=task, chosen=chosen)


def test_how_an_agent_learned(compared, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    agent = changed(best_of(compared)[0], {"train": {}, "steps": None})
    seed = agent.chosen.cell.seed
    own = f"--env {ENV} --repr esc --seed {seed}"
    assert command(agent) == f"esc-train {own}"
    first = f"runs/taught/{ENV}-imitation/runs/esc-s{seed}"
    second = {"ppo": {"train_env_config": {"collision_reward": -30}}}
    taught = changed(agent, {"train": second, "steps": 16}, start_from=first)
    # Of a run of another machine no more is known than where it was.
    assert learned(taught) == f"trained with PPO for 32 steps, from {first} on"
    train = (
        f"esc-train {own} --ppo.train-env-config '{{collision_reward: -30}}' --steps 16 "
        f"--start-from {first}"
    )
    assert (command(taught), steps(taught)) == (train, "32")
    imitate = {"labels": 1000, "rounds": 3, "planner": {"free": 2}}
    store.begin_task(
        tmp_path / "runs/taught", small(learn="imitate", imitate=imitate, train={}), ENV
    )
    assert learned(taught) == (
        "trained with PPO for 32 steps, after imitation of a planner, from 4,000 labels or more"
    )
    assert steps(taught) == "4,000 by imitation, then 32"
    assert command(taught) == (
        f"esc-imitate {own} --expert planner --labels 1000 --rounds 3 --planner.free 2 "
        f"--run-dir {first} && {train}"
    )


def test_how_an_agent_imitates(compared):
    agent = best_of(compared)[0]
    seed = agent.chosen.cell.seed
    cell = replace(agent.chosen.cell, algo="imitation")
    imitated = changed(agent, {"imitate": {"batch_size": 64, "planner": {"free": 2}}})
    imitated = replace(imitated, chosen=replace(imitated.chosen, cell=cell))
    assert learned(imitated) == "learned by imitation of a planner, from 32 labels or more"
    assert command(imitated) == (
        f"esc-imitate --env {ENV} --repr esc --seed {seed} --expert planner --batch-size 64 "
        "--planner.free 2"
    )
