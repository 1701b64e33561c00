"""Drivers that have learned nothing: the planner in batches, and on film."""

import json

import numpy as np
import pytest
from PIL import Image

from esc_agents.cli import eval as eval_cli
from esc_agents.driving.baselines import rule_driver
from esc_agents.driving.environments import make_env
from esc_agents.driving.experts import drive, film_expert
from esc_gym.planning import LookAhead
from tests.esc_agents.tiny import tiny

SEEDS = range(5, 8)


@pytest.mark.parametrize("knows", ["all", "observed"])
def test_the_planner_drives_alike_in_any_company(knows):
    planner = LookAhead(horizon=3, knows=knows)
    together, alone = (
        drive(planner, tiny().model_copy(update={"n_envs": count}), SEEDS) for count in (3, 1)
    )
    assert together == alone
    assert [episode.seed for episode in together] == list(SEEDS)


def test_its_episode_is_that_of_its_actions_in_a_single_environment(monkeypatch, tmp_path):
    """What is filmed: the actions that were planned in a batch, in an environment by itself."""
    taken = []
    monkeypatch.setattr(
        "esc_agents.driving.experts.film",
        lambda config, policy, seed, folder: taken.extend(policy(None) for _ in range(6)),
    )
    planner, config = LookAhead(horizon=3), tiny()
    (episode,) = drive(planner, config, [5])
    film_expert(planner, config, 5, tmp_path)
    env, rewards = make_env(config), []
    env.reset(seed=5)
    for (action,) in taken[: episode.length]:
        rewards.append(env.step(action)[1])
    assert sum(rewards) == episode.reward


def test_the_rule_driver_is_an_expert():
    assert drive(None, tiny(), SEEDS) == rule_driver(tiny(), SEEDS)


def test_films_and_results(call, tmp_path):
    config = ["--env", "highway-fast", "--env-config", "{duration: 3, vehicles_count: 5}"]
    for expert in ("planner", "idm"):
        code, out, err = call(
            eval_cli, "--expert", expert, *config, "--episodes", "2", "--json", "r.json",
            "--video", expert, "--videos", "1",
        )  # fmt: skip
        assert (code, err) == (0, "")
        found = json.loads((tmp_path / "r.json").read_text())
        assert found["policy"] == {"planner": "planner, knows all", "idm": "IDM/MOBIL"}[expert]
        assert found["policy"] in out
        assert [drive["seed"] for drive in found["drives"]] == [2_000_000, 2_000_001]
        with Image.open(tmp_path / expert / "seed-2000000.gif") as image:
            assert np.asarray(image.convert("RGB")).std() > 0
            assert image.n_frames >= 3


def test_the_planner_in_the_table_of_a_run(ppo_run):
    """On the run's own episodes, as a batch of one drives them here."""
    (episode,) = drive(LookAhead(free=1), tiny(), [tiny().evaluation.seed])
    rows = {row["policy"]: row for row in json.loads((ppo_run / "results.json").read_text())}
    found = rows["planner, knows all"]
    assert (found["reward"], found["length"]) == (episode.reward, episode.length)
