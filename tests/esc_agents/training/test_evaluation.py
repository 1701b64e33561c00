"""esc-eval, through its command."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from esc_agents.cli import eval as eval_cli
from esc_agents.cli.eval import command
from esc_agents.driving.environments import make_env
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError
from esc_agents.reporting.statistics import wilson_interval
from esc_agents.training.run_directory import open_run
from esc_agents.training.train import train
from tests.esc_agents.tiny import ROAD, tiny


def report(path, *args):
    file = path.parent / f"{abs(hash(args))}.json"
    assert command([str(path), "--device", "cpu", "--json", str(file), *args]) == 0
    return json.loads(file.read_text())


def test_report(ppo_run, capsys):
    found = report(ppo_run, "--episodes", "3", "--seed", "40")
    drives = found["drives"]
    assert [drive["seed"] for drive in drives] == [40, 41, 42]
    assert found["reward"] == pytest.approx(np.mean([drive["reward"] for drive in drives]))
    crashes = sum(drive["crashed"] for drive in drives)
    low, high = wilson_interval(crashes, 3)
    assert (found["collision_low"], found["collision_high"]) == pytest.approx((low, high))
    assert f"{found['reward']:.2f}" in capsys.readouterr().out


def test_esc_drives_the_same_when_its_vehicles_are_shuffled(ppo_run):
    plain = report(ppo_run, "--episodes", "4")
    shuffled = report(ppo_run, "--episodes", "4", "--shuffle")
    assert plain["drives"] == shuffled["drives"]
    assert len({drive["reward"] for drive in plain["drives"]}) > 1


def test_sac_too(sac_run):
    drives = report(sac_run, "--episodes", "2")["drives"]
    assert [drive["crashed"] for drive in drives] == [False, False]
    assert drives[0]["min_ttc"] is None  # nobody else is on that road


def test_videos_of_the_first_episodes(ppo_run, tmp_path):
    folder = tmp_path / "deep" / "films"
    args = ["--episodes", "2", "--seed", "9", "--videos", "1", "--device", "cpu"]
    assert command([str(ppo_run), "--video", str(folder), *args]) == 0
    assert [file.name for file in folder.iterdir()] == ["seed-9.gif"]
    with Image.open(folder / "seed-9.gif") as film:
        assert film.n_frames > 5


def test_other_traffic(ppo_run, call):
    """The drives of the network itself, which never counts its rows, among more vehicles."""
    args = ["--episodes", 3, "--seed", 5, "--device", "cpu", "--json", "other.json"]
    more = ["--env-config", "{vehicles_count: 9}", "--video", "films", "--videos", 1]
    code, out, _ = call(eval_cli, ppo_run, *args, *more)
    assert code == 0
    words = "highway-fast-v0, ppo, 32 steps; driving in highway-fast-v0 {vehicles_count: 9};"
    assert words in " ".join(out.split())
    assert [path.name for path in Path("films").iterdir()] == ["seed-5.gif"]
    found = json.loads(Path("other.json").read_text())
    assert found["driven"] == "highway-fast-v0 {vehicles_count: 9}"

    config = open_run(ppo_run)
    policy = load_policy(ppo_run)[0]
    env = make_env(config.model_copy(update={"env_config": {**ROAD, "vehicles_count": 9}}))
    for drive in found["drives"]:
        observation, _ = env.reset(seed=drive["seed"])
        assert observation["mask"].shape == (9,)
        ended, rewards = False, []
        while not ended:
            with torch.no_grad():
                tensors = {k: torch.as_tensor(v)[None].float() for k, v in observation.items()}
                action = policy._predict(tensors, deterministic=True).item()
            observation, reward, terminated, truncated, _ = env.step(action)
            rewards.append(reward)
            ended = terminated or truncated
        assert drive["reward"] == pytest.approx(sum(rewards))


def test_another_scenario_is_as_it_is_shipped(ppo_run, call):
    """Its traffic, with the observation of the run: not the narrow ranges of highway-dense."""
    args = ["--episodes", 1, "--device", "cpu", "--json", "dense.json"]
    short = ["--env-config", "{duration: 3}"]
    code, out, _ = call(eval_cli, ppo_run, *args, "--env", "highway-dense", *short)
    assert code == 0
    assert "driving in highway-dense {duration: 3};" in " ".join(out.split())
    drive = json.loads(Path("dense.json").read_text())["drives"][0]
    assert drive["length"] <= 3
    assert drive["vehicles"] > 9  # the run's own road has 6


def test_sac_in_other_traffic_wins_over_its_own_preset(sac_run, call):
    args = ["--episodes", 1, "--device", "cpu", "--json", "other.json"]
    changes = ["--env-config", "{policy_frequency: 1, simulation_frequency: 5}"]
    lengths = {}
    for more in ([], changes):
        assert call(eval_cli, sac_run, *args, *more)[0] == 0
        lengths[len(more)] = json.loads(Path("other.json").read_text())["drives"][0]["length"]
    assert lengths[2] < lengths[0]


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--env", "roundabout"], "got ego_features [] in training and [dest_x, dest_y] here"),
        (["--env", "nowhere"], "env: unknown environment or scenario 'nowhere'"),
        (["--env-config", "{vehicle_count: 3}"], "unknown key 'vehicle_count'; did you mean"),
        (["--env-config", "3"], "env_config should be a mapping, got 3"),
        (["--env-config", "{action: {type: ContinuousAction}}"],
         "in training and {type: ContinuousAction, longitudinal: true, lateral: true} here"),
        (["--env-config", "{action: {lateral: false}}"],
         "lateral: true} in training and {type: DiscreteMetaAction, longitudinal: true, lat"),
    ],
)  # fmt: skip
def test_traffic_that_the_policy_has_not_learned(ppo_run, call, args, words):
    code, _, err = call(eval_cli, ppo_run, "--device", "cpu", *args)
    assert code == 2
    assert err.startswith("esc-eval: ")
    assert err.count("\n") == 1
    assert words in err


def test_slots_that_are_rows_know_no_other_number(tmp_path, call):
    encoder = {"hidden": (8,), "code_dim": 200}
    assert train(tiny(repr="fp", run_dir=tmp_path / "run", encoder=encoder))
    args = ["run", "--device", "cpu", "--episodes", 1, "--env-config"]
    code, _, err = call(eval_cli, *args, "{vehicles_count: 9}")
    assert (code, err.count("\n")) == (2, 1)
    assert "FPEncoder: expected N = 6, as in training, got 9" in err
    assert call(eval_cli, *args, "{lanes_count: 2}")[0] == 0


def test_what_the_run_learned_from_has_to_be_known(own_run, call):
    args = [own_run, "--device", "cpu", "--env-config", "{vehicles_count: 9}"]
    (own_run / "wrapper.json").write_text("{}")
    assert "does not match its checksum" in call(eval_cli, *args)[2]
    (own_run / "SHA256SUMS").unlink()
    assert "wrapper.json is damaged or missing: KeyError: 'features'" in call(eval_cli, *args)[2]


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--json", "nowhere/a.json"], "folder nowhere does not exist"),
        (["--json", "."], "expected a file"),
        (["--video", "file"], "video: folder file: File exists"),
        (["--device", "abacus"], "device: expected auto, cpu or cuda, got 'abacus'"),
    ],
)
def test_outputs_are_checked_before_the_drive(ppo_run, args, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr("esc_agents.training.evaluation.vectorise", None)  # no drive can begin
    with pytest.raises(UserError, match=message):
        command([str(ppo_run), *args])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_damaged_run(own_run):
    (own_run / "policy.safetensors").write_bytes(b"")
    with pytest.raises(UserError, match=r"policy.safetensors does not match the checksum"):
        command([str(own_run)])
    for file in own_run.glob("*policy.*"):
        file.unlink()
    with pytest.raises(UserError, match=r"model.zip holds pickled .* add --trust"):
        command([str(own_run)])
    (own_run / "model.zip").write_bytes(b"")
    with pytest.raises(UserError, match=r"model.zip is damaged"):
        command([str(own_run), "--trust"])
    (own_run / "model.zip").unlink()
    with pytest.raises(UserError, match="holds no policy yet"):
        command([str(own_run)])
    (own_run / "config.yaml").write_text("steps: [")
    with pytest.raises(UserError, match=r"config.yaml does not match its checksum"):
        command([str(own_run)])
    (own_run / "SHA256SUMS").unlink()
    with pytest.raises(UserError, match="not readable as YAML"):
        command([str(own_run)])


def test_the_best_policy_where_the_run_has_not_ended(own_run, capsys):
    (own_run / "policy.json").unlink()
    report(own_run, "--episodes", "1")
    steps = json.loads((own_run / "best_policy.json").read_text())["steps"]
    assert f"ppo, {steps} steps" in capsys.readouterr().out


def test_a_trusted_zip_drives_the_same(own_run):
    safe = report(own_run, "--episodes", "2")
    for file in own_run.glob("*policy.*"):
        file.unlink()
    assert report(own_run, "--episodes", "2", "--trust") == safe
