"""Data sets: opened by Minari alone, resumed after a kill, refused where they are of others."""

import json
import shutil
import subprocess
import sys

import numpy as np
import pytest

from esc_agents.cli import collect as collect_cli
from esc_agents.driving.checks import check_env
from esc_agents.driving.environments import wrapper_json
from esc_agents.errors import UserError
from esc_agents.imitation import collect as collecting, datasets, labels
from tests.esc_agents.imitation.small import gathered

CONFIG = gathered()
ALONE = """
import json, minari
made = minari.load_dataset("tiny-v0")
episodes = list(made.iterate_episodes())
print(json.dumps({
    "seeds": [int(seed["seed"]) for seed in made.storage.get_episode_metadata(range(5))],
    "steps": made.total_steps,
    "spaces": [len(made.spec.observation_space.spaces), int(made.spec.action_space.n)],
    "fits": all(made.spec.observation_space.contains(
        {k: v[0] for k, v in e.observations.items()}) for e in episodes),
    "returns": [float(e.rewards.sum()) for e in episodes],
    "values": [e.infos["expert_values"].tolist() for e in episodes],
}))
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "tiny-v0"
    assert collecting.collect(CONFIG, path)
    return path


@pytest.fixture(scope="module")
def observation():
    return wrapper_json(check_env(CONFIG.train_config()))


def test_minari_opens_it_in_a_process_of_its_own(made, observation):
    environment = {"MINARI_DATASETS_PATH": str(made.parent), "PATH": ""}
    done = subprocess.run(
        [sys.executable, "-c", ALONE], env=environment, capture_output=True, text=True, check=True
    )
    found = json.loads(done.stdout)
    drives = datasets.read(made, observation, 5)
    assert found["seeds"] == [drive.seed for drive in drives] == list(range(5))
    assert found["steps"] == sum(len(drive.actions) for drive in drives)
    assert found["spaces"] == [3, 5]
    assert found["fits"]
    np.testing.assert_allclose(found["returns"], [drive.rewards.sum() for drive in drives])
    for values, drive in zip(found["values"], drives, strict=True):
        np.testing.assert_array_equal(np.float32(values), drive.values)


def test_nothing_else_is_left(made):
    assert [path.name for path in made.parent.iterdir()] == ["tiny-v0"]


def test_killed_and_begun_again(made, observation, tmp_path, monkeypatch):
    """The second of three parts: what was kept is not driven again, and all is as it would be."""
    seeds = []

    def dying(envs, chosen, *args):
        seeds.extend(chosen)
        if len(seeds) == 4:
            raise KeyboardInterrupt
        return original(envs, chosen, *args)

    original = labels.collect
    monkeypatch.setattr(labels, "collect", dying)
    with pytest.raises(KeyboardInterrupt):
        collecting.collect(CONFIG, tmp_path / "tiny-v0")
    assert not (tmp_path / "tiny-v0").exists()
    with pytest.raises(UserError, match="holds episodes of a command with other values"):
        collecting.collect(gathered(noise=0.5), tmp_path / "tiny-v0")
    seeds.clear()
    monkeypatch.setattr(labels, "collect", lambda envs, chosen, *args: (
        seeds.extend(chosen), original(envs, chosen, *args))[1])  # fmt: skip
    assert collecting.collect(CONFIG, tmp_path / "tiny-v0")
    assert seeds == [2, 3, 4]
    for one, two in zip(
        datasets.read(made, observation, 5),
        datasets.read(tmp_path / "tiny-v0", observation, 5),
        strict=True,
    ):
        np.testing.assert_array_equal(one.values, two.values)
        np.testing.assert_array_equal(one.actions, two.actions)
        for name, part in one.observations.items():
            np.testing.assert_array_equal(part, two.observations[name])


@pytest.mark.parametrize("name", ["main_data.hdf5", "metadata.json"])
def test_a_damaged_one_is_named(name, made, observation, tmp_path):
    copy = shutil.copytree(made, tmp_path / "tiny-v0")
    path = copy / "data" / name
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(UserError, match=rf"{name} does not match its checksum"):
        datasets.read(copy, observation, 5)
    (copy / "data" / "SHA256SUMS").unlink()
    path.write_bytes(b"nothing")
    with pytest.raises(UserError, match=r"tiny-v0 is damaged"):
        datasets.read(copy, observation, 5)


def test_data_of_another_scenario(made, observation):
    run = CONFIG.train_config()
    assert datasets.read(made, observation, 5, run)
    other = run.model_copy(update={"env": "highway-v0"})
    with pytest.raises(UserError, match=f"expected labels of highway-v0, got {run.env}'s"):
        datasets.read(made, observation, 5, other)
    other = run.model_copy(update={"env_config": {**run.env_config, "lanes_count": 2}})
    with pytest.raises(UserError, match="same env_config, lanes_count=2, got lanes_count=3; give"):
        datasets.read(made, observation, 5, other)


def test_one_episode_is_too_few(tmp_path, observation):
    path = tmp_path / "one-v0"
    collecting.collect(CONFIG.model_copy(update={"episodes": 1}), path)
    with pytest.raises(UserError, match="expected 2 episodes or more"):
        datasets.read(path, observation, 5)


def test_data_of_others(made, observation, tmp_path):
    with pytest.raises(UserError, match="expected labels of 3 actions, got 5"):
        datasets.read(made, observation, 3)
    with pytest.raises(UserError, match="same observation, got perception_distance"):
        datasets.read(made, observation | {"perception_distance": 7.0}, 5)
    with pytest.raises(UserError, match="expected sets of up to N=3 vehicles, got N="):
        datasets.read(made, observation | {"max_vehicles": 3}, 5)
    with pytest.raises(UserError, match="no data set in"):
        datasets.read(tmp_path, observation, 5)
    copy = shutil.copytree(made, tmp_path / "tiny-v0")
    described = copy / "data" / "metadata.json"
    described.write_text(json.dumps({
        key: value for key, value in json.loads(described.read_text()).items() if key != "esc_gym"
    }))  # fmt: skip
    (copy / "data" / "SHA256SUMS").unlink()
    with pytest.raises(UserError, match="expected a data set of esc-collect, got another"):
        datasets.read(copy, observation, 5)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("--expert oracle", "expert: expected planner, idm, run:DIR or run:zoo:NAME, got 'oracle'"),
        ("--expert run:nowhere", "nowhere is no run directory"),
        ("--env parking --expert idm", "idm: parking-v0: expected an environment with meta-act"),
        ("--env parking", "got the continuous actions of parking-v0, with which only esc-eval"),
        ("--out labels", "out: expected a name that ends with a version, as -v0, got 'labels'"),
        ("--planner.milliseconds 5", "--planner.milliseconds: labels must not depend on the ma"),
        (
            "--planner.free 4 --planner.horizon 3",
            "--planner.free: expected at most the horizon, 3, got 4",
        ),
        ("--episodes 0", "episodes should be greater than 0, got 0"),
    ],
)
def test_what_users_get_wrong(flags, message, call, tmp_path):
    code, out, err = call(collect_cli, "--env", "highway-fast", *flags.split())
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_relative_directory(call, tmp_path):
    road = "{vehicles_count: 4, duration: 2}"
    flags = ["--env", "highway-fast", "--env-config", road, "--planner.horizon", "2"]
    code, _, err = call(
        collect_cli, *flags, "--episodes", "2", "--out", "a/b/few-v0", "--planner.free", "1"
    )
    assert (code, err) == (0, "")
    minari = pytest.importorskip("minari")
    assert minari.MinariDataset(tmp_path / "a" / "b" / "few-v0" / "data").total_episodes == 2
    assert [path.name for path in (tmp_path / "a" / "b").iterdir()] == ["few-v0"]


def test_an_existing_directory(call, tmp_path):
    (tmp_path / "here-v0").mkdir()
    code, _, err = call(collect_cli, "--env", "highway-fast", "--out", "here-v0")
    assert (code, err) == (
        2, "esc-collect: out: here-v0 already exists; give another --out, or remove it\n"
    )  # fmt: skip


def test_without_minari(call, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "minari", None)
    code, _, err = call(collect_cli, "--env", "highway-fast")
    assert code == 2
    assert "pip install 'esc-gym[data]'" in err
