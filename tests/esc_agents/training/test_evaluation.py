"""esc-eval, through its command."""

import json

import numpy as np
import pytest
from PIL import Image

from esc_agents.cli.eval import command
from esc_agents.errors import UserError
from esc_agents.reporting.statistics import wilson_interval


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
