"""esc-compare as the shell calls it: configurations, and what a user can get wrong."""

import sys
from functools import partial
from pathlib import Path

import pytest

from esc_agents.cli import compare as cli
from esc_agents.compare.grid import CompareConfig, scenario
from esc_agents.config import load, shipped
from tests.esc_agents.compare.small import ENV, HereEngine

TINY = f"""
env: [{ENV}]
repr: [esc, fp]
seeds: 1
steps: 32
episodes: 2
tuning: {{seeds: 0}}
train:
  n_envs: 2
  env_config: {{vehicles_count: 6, duration: 6, lanes_count: 3}}
  encoder: {{hidden: [8], code_dim: 200}}
  ppo: {{n_steps: 16, batch_size: 16, n_epochs: 1, net_arch: [8]}}
  evaluation: {{episodes: 1}}
"""


@pytest.fixture
def compare(call):
    """(code, out, err) of esc-compare, in a folder with tiny.yaml."""
    Path("tiny.yaml").write_text(TINY)
    return partial(call, cli)


def test_from_nothing_to_a_report(compare, monkeypatch):
    monkeypatch.setattr("esc_agents.compare.engines.LocalEngine", lambda workers: HereEngine())
    code, out, err = compare("--config", "tiny.yaml", "--out", "found", "--workers", "1")
    assert (code, err) == (0, "")
    assert "[1/2] highway-fast-v0-ppo/esc-s0: done" in out
    assert "IDM/MOBIL" in out
    assert "Written into found: report.md, report.html" in out
    assert Path("found/command.txt").read_text() == (
        "esc-compare --config tiny.yaml --out found --workers 1\n"
    )
    assert "`esc-compare --config tiny.yaml --out found" in Path("found/report.md").read_text()


@pytest.mark.slow
def test_a_dry_run_trains_nothing(compare):
    code, out, err = compare("--config", "tiny.yaml", "--dry-run", "--seeds", "3")
    assert (code, err) == (0, "")
    assert [f"{ENV} {name}: " in out for name in ("esc", "fp")] == [True, True]
    assert out.count("training steps/s") == 2
    assert "Memory" in out
    (row,) = [line for line in out.splitlines() if " fp " in line]
    # N, Z, tuning runs, runs, finished, steps
    assert [cell.strip() for cell in row.split("│")[1:-1]] == [
        f"{ENV} fp",
        "6",
        "6",
        "0",
        "3",
        "0",
        "32",
    ]
    assert not Path("runs").exists()


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_the_directory_of_a_run_is_refused(compare, dry):
    Path("run").mkdir()
    Path("run/config.yaml").touch()
    code, _, err = compare("--config", "tiny.yaml", "--out", "run", *dry)
    assert (code, err.count("\n")) == (2, 1)
    assert "--out run: is the directory of a training run" in err


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--env", "highway-dens"], "unknown environment or scenario 'highway-dens'; did you mean"),
        (["--repr", "esk"], "repr: unknown representation 'esk'"),
        (["--seeds", "0"], "seeds should be greater than or equal to 1, got 0"),
        (["--steps", "x"], "steps"),
        (["--algo", "sac", "--env", "merge", "--train", "{}"], "cannot do continuous actions"),
        (["--engine", "dask"], "engine"),
        (["--engine", "ray", "--address", "127.0.0.1:1"], "127.0.0.1:1: Connection refused"),
        (["--train", "{ppo: {n_step: 5}}"], "train: unknown key 'ppo.n_step'; did you mean"),
        (["--transfer", "{exit: {a: {}}}"], "transfer: expected scenarios of the grid, got 'exit'"),
        (["--config", "studi"], "config: no file 'studi' and no such comparison; did you mean"),
        (["--out", "tiny.yaml"], "--out tiny.yaml: File exists"),
    ],
)  # fmt: skip
def test_mistakes_are_one_line_and_exit_code_2(compare, args, message):
    if "--config" not in args:
        args = ["--config", "tiny.yaml", *args]
    code, _, err = compare(*args)
    assert code == 2
    assert err.startswith("esc-compare: ")
    assert message in err
    assert err.count("\n") == 1


def test_ray_without_ray(compare, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    code, _, err = compare("--config", "tiny.yaml", "--engine", "ray")
    assert (code, err) == (
        2,
        "esc-compare: --engine ray: Ray is not installed; install it with: pip install "
        "'esc-gym[ray]'\n",
    )


@pytest.mark.parametrize("name", sorted(shipped("compare")))
def test_shipped_comparisons(name):
    config = load(name, "compare", CompareConfig)
    for env in config.env:
        for traffic in ("", *config.transfer.get(env, {})):
            assert scenario(config, env, traffic).algo == config.algo
