"""Numbers of a comparison, derived again by hand from results made by hand."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from esc_agents.compare import analysis, store
from esc_agents.compare.analysis import Task
from esc_agents.reporting.statistics import Estimate, wilson_interval
from tests.esc_agents.compare.small import ENV, MORE, baselines, episode, result, small

SCORES = {"esc": [4.0, 6.0, 8.0], "fp": [3.0, 4.0, 5.0], "ap": [-1.0, 0.0, -2.0]}


def task(scores=SCORES, env=ENV, **floors) -> Task:
    """Runs whose final policies had two episodes each, one above and one below the score."""
    results = [
        result(repr, seed, [score - 1, score + 1], env=env)
        for repr, runs in scores.items()
        for seed, score in enumerate(runs)
    ]
    settings = {"env": env, "algo": "ppo", "steps": 32, "transfer": {}}
    return Task(Path("x"), settings, baselines(**floors), results[::-1], [])


def test_scores_are_by_seed_and_representations_in_the_packages_order():
    assert task().reprs == ["esc", "fp", "ap"]
    assert task().scores("esc") == SCORES["esc"]
    assert task({"own.x:Y": [1.0], "fp": [1.0]}).reprs == ["fp", "own.x:Y"]
    assert task({"fp": [1.0], "ap": [1.0]}).pairs == []  # nothing to compare with


def test_each_pair_of_ours_and_another_is_compared_once():
    assert task({name: [1.0] for name in ("max", "esc-exp", "esc", "fp")}).pairs == [
        ("esc", "esc-exp"), ("esc", "fp"), ("esc", "max"), ("esc-exp", "fp"), ("esc-exp", "max")
    ]  # fmt: skip
    assert task({"esc-exp": [1.0], "fp": [1.0]}).pairs == [("esc-exp", "fp")]


def test_a_row():
    found = analysis.row(task(), "ap")
    assert (found.runs, found.mean.value, found.middle.value) == (3, -1.0, -1.0)
    # Episodes: -2, 0, -1, 1, -3, -1; below 0 is a crash.
    assert found.collisions == Estimate(4 / 6, *wilson_interval(4, 6))
    assert found.means["speed"] == 20.0
    assert -2 <= found.mean.low < -1 < found.mean.high <= 0


@pytest.mark.parametrize(
    ("ours", "theirs", "verdict"),
    [
        ([5.0, 5.1, 5.2], [1.0, 1.1, 1.2], "wins"),
        ([1.0, 1.1, 1.2], [5.0, 5.1, 5.2], "loses"),
        ([1.0, 5.0, 3.0], [2.0, 3.0, 5.0], "ties"),
        ([1.0], [5.0, 5.1], "has too few runs to tell"),
    ],
)
def test_verdicts(ours, theirs, verdict):
    (duel,) = analysis.duels(task({"esc": ours, "fp": theirs}))
    assert (duel.ours, duel.rival, duel.verdict) == ("esc", "fp", verdict)
    assert duel.difference.value == pytest.approx(np.mean(ours) - np.mean(theirs))
    wins = np.mean([a > b for a in ours for b in theirs])
    ties = np.mean([a == b for a in ours for b in theirs])
    assert duel.better.value == pytest.approx(wins + ties / 2)


def test_normal_scores_run_from_the_best_blind_policy_to_the_rule_driver():
    assert task(blind=2.0, rule=6.0).normal("esc") == [0.5, 1.0, 1.5]
    assert task(blind=6.0, rule=2.0).normal("esc") is None
    alone = replace(task(), baselines=replace(baselines(), rule=None))
    assert alone.normal("esc") is None
    assert list(analysis.drivers(alone)) == ["always IDLE", "random"]


def test_overall_takes_only_what_ran_everywhere():
    tasks = [
        task(blind=0.0, rule=10.0),
        task({"esc": [1.0, 2.0], "fp": [0.0, 1.0]}, "merge-dense", blind=0.0, rule=2.0),
        task({"esc": [9.0], "fp": [9.0]}, "exit", blind=3.0, rule=2.0),  # no scale there
    ]
    found = analysis.overall(tasks)
    assert list(found) == ["esc", "fp"]
    scores = [0.4, 0.6, 0.8, 0.5, 1.0]
    assert found["esc"].value == pytest.approx(stats.trim_mean(scores, 0.25))
    better = analysis.overall_duels(tasks[:2])
    # fp: of nine pairs esc wins 7 and ties 1 (4 beside 3, 4, 5), elsewhere 3 of 4 and a tie.
    assert better["esc", "fp"].value == pytest.approx(((7 + 0.5) / 9 + (3 + 0.5) / 4) / 2)
    assert better["esc", "ap"].value == 1.0  # in the one scenario in which it ran


def test_above_the_floor_is_above_every_blind_interval():
    # Three episodes at -1, 0 and 1: Student's t gives 2.48 at the upper end.
    high = stats.t.ppf(0.975, 2) / np.sqrt(3)
    assert task().reach == pytest.approx(high)
    assert analysis.above_floor(task(), "esc")
    assert not analysis.above_floor(task(), "ap")
    assert not analysis.above_floor(task(blind=3.0), "esc")
    assert task(blind=3.0).floor[0] == "always IDLE"


def test_shuffling():
    runs = [
        result("esc", 0, [4.0, 6.0], shuffled=[4.0, 6.0]),
        result("ap", 0, [4.0, 6.0], shuffled=[1.0, 1.0]),
        result("ap", 1, [2.0, 2.0], shuffled=[3.0, 3.0]),
    ]
    both = Task(Path("x"), {"env": ENV, "algo": "ppo"}, baselines(), runs, [])
    esc, ap = analysis.shuffle(both, "esc"), analysis.shuffle(both, "ap")
    assert (esc.plain, esc.shuffled, esc.change.value, esc.changed) == (5.0, 5.0, 0.0, 0.0)
    assert (ap.plain, ap.shuffled, ap.change.value) == (3.5, 2.0, -1.5)
    assert (ap.decisions, ap.changed) == (20, pytest.approx(0.1))


def test_transfer_matrix():
    own = result("esc", 0, [4.0], traffic="")
    own.drives["more"] = [episode(1.0)]
    other = result("esc", 0, [8.0], traffic="more")
    other.drives["as it is"] = [episode(2.0)]
    settings = {"env": ENV, "algo": "ppo", "transfer": MORE}
    found = analysis.transfer(Task(Path("x"), settings, baselines(), [own, other], []), "esc")
    assert found == {
        "as it is": {"as it is": 4.0, "more": 1.0},
        "more": {"more": 8.0, "as it is": 2.0},
    }
    # What was trained in other traffic is no run of the comparison itself.
    assert analysis.row(Task(Path("x"), settings, baselines(), [own, other], []), "esc").runs == 1


def test_load_leaves_out_what_is_not_there_yet(tmp_path):
    assert analysis.load(tmp_path) == []
    store.begin_task(tmp_path, small(), ENV)
    store.write(tmp_path, result("esc", 0, [1.0]))
    assert analysis.load(tmp_path) == []  # no baselines
    store.write_baselines(tmp_path / f"{ENV}-ppo", baselines())
    (found,) = analysis.load(tmp_path)
    assert (found.name, found.reprs) == (f"{ENV}, PPO", ["esc"])
