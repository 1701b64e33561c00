import json
from dataclasses import asdict, replace
from math import inf

import pytest

from esc_agents.compare import store
from esc_agents.compare.grid import Candidate, Cell
from esc_agents.compare.store import Tuned
from esc_agents.driving.episodes import as_rows
from esc_agents.errors import UserError
from esc_agents.reporting import records
from tests.esc_agents.compare.small import ENV, MORE, baselines, episode, result, small


def test_results_come_back_as_they_were(tmp_path):
    first = result("fp", 3, [1.5, -2.0], candidate=Candidate(2.0, 0.1))
    never = [episode(1.0, ttc=inf), episode(0.1 + 0.2)]
    first = replace(first, drives={"": never, "more": never[:1]})
    store.write(tmp_path, first)
    assert store.read(tmp_path, first.cell) == first
    assert store.results(tmp_path / f"{ENV}-ppo") == [first]
    assert store.read(tmp_path, replace(first.cell, seed=4)) is None


def test_tuning_runs_lie_apart(tmp_path):
    cell = Cell(ENV, "ppo", "esc", 1000, candidate=Candidate(2.0, 0.1), tuning=True)
    run = Tuned(cell, [1.0, 2.0], 3.0, {})
    store.write(tmp_path, run)
    assert store.read(tmp_path, cell) == run
    folder = tmp_path / f"{ENV}-ppo"
    assert (store.results(folder), store.tuned(folder)) == ([], [run])


def test_baselines_come_back(tmp_path):
    assert store.baselines(tmp_path) is None
    store.write_baselines(tmp_path, baselines())
    assert store.baselines(tmp_path) == baselines()
    without = replace(baselines(), rule=None, missing={"IDM/MOBIL": "no lanes"})
    store.write_baselines(tmp_path, without)
    assert store.baselines(tmp_path) == without


def test_baselines_of_before_always_had_a_rule_driver(tmp_path):
    found = baselines()
    old = {"blind": as_rows(found.blind), "rule": asdict(found.rule), "made_with": found.made_with}
    records.write(tmp_path / "baselines.json", 1, old)
    assert store.baselines(tmp_path) == found


@pytest.mark.parametrize("damage", ["cut", "changed", "empty", "other", "schema", "fields"])
def test_damaged_results_are_named(tmp_path, damage):
    run = result("esc", 0, [1.0])
    store.write(tmp_path, run)
    path = store.path_of(tmp_path, run.cell)
    text = path.read_text()
    if damage == "other":
        store.write(tmp_path, result("esc", 1, [1.0]))
        store.path_of(tmp_path, replace(run.cell, seed=1)).rename(path)
    elif damage == "fields":
        records.write(path, store.SCHEMA, {"cell": {}})
    else:
        changed = {
            "cut": text[:-30],
            "changed": text.replace("1000", "1001"),
            "empty": "",
            "schema": json.dumps({**json.loads(text), "schema": 99}),
        }
        path.write_text(changed[damage])
    with pytest.raises(UserError, match=r"esc-s0\.json.*remove it and start again"):
        store.read(tmp_path, run.cell)


def test_a_task_is_what_it_was(tmp_path):
    for _ in range(2):
        store.begin_task(tmp_path, small(), ENV)
    store.begin_task(tmp_path, small(seeds=5, repr=("esc", "attention")), ENV)  # more of the same
    with pytest.raises(UserError, match=r"task\.yaml: begun with steps=32, now asked for with 64"):
        store.begin_task(tmp_path, small(steps=64), ENV)
    with pytest.raises(UserError, match="transfer"):
        store.begin_task(tmp_path, small(transfer={}), ENV)
    (folder,) = store.task_folders(tmp_path)
    assert store.task_settings(folder)["transfer"] == MORE
    (folder / "task.yaml").write_text("[")
    with pytest.raises(UserError, match=r"task\.yaml is damaged"):
        store.begin_task(tmp_path, small(), ENV)
