"""The learning report: from run directories to the page, the figure and the table."""

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

from esc_agents.cli import learning as learning_cli
from esc_agents.config import TrainConfig, dump, load_config, scenario_name, scenarios
from esc_agents.driving.episodes import Episode, Summary, as_rows
from esc_agents.errors import UserError
from esc_agents.training.run_directory import write_checksums


def summary(mean, ttc=1.0):
    """Ten episodes with returns mean - 1 and mean + 1."""
    returns = [mean - 1, mean + 1] * 5
    drives = [Episode(i, r, 5, i < 3, 25.0, 99.0, 0.0, 1, 4.0, ttc) for i, r in enumerate(returns)]
    return Summary.of(drives)


@pytest.fixture
def make_run(tmp_path):
    def make(seed, mean=5.0, blind=2.0, rule=None, **changes):
        path = tmp_path / f"seed-{seed}"
        path.mkdir()
        values = {
            **load_config("highway-dense").model_dump(),
            "seed": seed,
            "steps": 300,
            **changes,
        }
        (path / "config.yaml").write_text(dump(TrainConfig.model_validate(values)))
        (path / "command.txt").write_text(f"esc-train --env highway-dense --seed {seed}\n")
        (path / "versions.json").write_text(json.dumps({"torch": "9.9", "device": "abacus"}))
        results = {
            "esc": summary(mean),
            "always IDLE": summary(blind),
            "always SLOWER": summary(0.0, ttc=float("inf")),
            **({"IDM/MOBIL": summary(rule)} if rule is not None else {}),
        }
        rows = as_rows(results)
        for row in rows:
            row["min_ttc"] = None if np.isinf(row["min_ttc"]) else row["min_ttc"]
        (path / "results.json").write_text(json.dumps(rows))
        metrics = "time/total_timesteps,eval/return\n100,\n200,1.23456789\n"
        (path / "metrics.csv").write_text(metrics)
        returns = np.array([[0.0, 2.0], [3.0, 4.0]])
        np.savez(path / "evaluations.npz", timesteps=np.array([100, 200]), results=returns)
        write_checksums(path)
        return path

    return make


def write(tmp_path, *runs):
    out = tmp_path / "docs" / "learning.md"
    assert learning_cli.command(["--runs", *map(str, runs), "--out", str(out)]) == 0
    return out


def test_the_page_says_what_was_run_and_what_came_out(make_run, tmp_path):
    out = write(tmp_path, make_run(1), make_run(0, mean=6.0))
    text = out.read_text()
    assert text.startswith("# Learning: highway-dense\n")
    assert "Above every blind baseline: in all 2 runs" in text
    assert (
        "in a collision: 30% (seed 0), 30% (seed 1); fewest among the blind policies: 30%" in text
    )
    assert "esc-train --env highway-dense --seed 0\nesc-train --env highway-dense --seed 1" in text
    assert "300 steps, seeds 0, 1; torch 9.9, device abacus." in text
    assert "| esc, seed 0 | 6.00 [5.25, 6.75] | 30% [11%, 60%] | 25.0 |" in text
    assert "| always IDLE | 2.00 [" in text
    assert text.partition("| always SLOWER")[2].partition("\n")[0].endswith("| none |")
    assert out.with_suffix(".png").read_bytes().startswith(b"\x89PNG")


def test_the_table_holds_every_runs_metrics(make_run, tmp_path):
    out = write(tmp_path, make_run(0), make_run(1))
    with out.with_suffix(".csv").open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows == [
        ["seed", "time/total_timesteps", "eval/return"],
        *([seed, *row] for seed in "01" for row in (["100", ""], ["200", "1.23457"])),
    ]


def test_overlap_is_said_with_its_numbers(make_run, tmp_path):
    text = write(tmp_path, make_run(0), make_run(1, mean=3.0)).read_text()
    assert "Not above every blind baseline" in text
    assert "in 1 of 2 runs (seed 1: 3.00 [2.25, 3.75] beside 2.00 [1.25, 2.75] of always" in text


def test_the_rule_driver_is_no_blind_policy(make_run, tmp_path):
    """Nor has a run of before it."""
    text = write(tmp_path, make_run(0), make_run(1, rule=9.0)).read_text()
    assert "Above every blind baseline: in all 2 runs" in text
    assert "| IDM/MOBIL | 9.00 [" in text


def test_an_unknown_scenario_is_called_by_its_id():
    config = TrainConfig(env="merge-v1", env_config={"duration": 3})
    assert scenario_name(config) == "merge-v1"
    assert [scenario_name(load_config(name)) for name in scenarios()] == [*scenarios()]


@pytest.mark.parametrize("name", ["results.json", "SHA256SUMS", "config.yaml"])
def test_an_unfinished_run(name, make_run, tmp_path):
    path = make_run(0)
    (path / name).unlink()
    with pytest.raises(UserError, match=f"seed-0 is no .*run.* expected .*{name}.* in it"):
        write(tmp_path, path)


@pytest.mark.parametrize("damage", ["[{}]", "{", '[{"policy": "esc"}]', "[]"])
def test_a_damaged_run(damage, make_run, tmp_path):
    path = make_run(0)
    (path / "results.json").write_text(damage)
    write_checksums(path)
    with pytest.raises(UserError, match="seed-0 is damaged"):
        write(tmp_path, path)


def test_runs_that_do_not_belong_together(make_run, tmp_path):
    path = make_run(0)
    with pytest.raises(UserError, match=r"expected a different seed each, got \[0, 0\]"):
        write(tmp_path, path, path)
    with pytest.raises(UserError, match="differ in steps, ppo"):
        write(tmp_path, path, make_run(1, steps=400, ppo={"gamma": 0.5}))
    with pytest.raises(UserError, match=r"blind policies of .* differ"):
        write(tmp_path, path, make_run(2, blind=1.0))
    with pytest.raises(SystemExit) as end:
        learning_cli.command([])
    assert end.value.code == 2
