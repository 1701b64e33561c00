"""What a run leaves behind, for PPO and SAC; continuing one; and what is refused before it."""

import csv
import json
import signal

import gymnasium as gym
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

import esc_gym  # noqa: F401  (registers the ids)
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.checks import check
from esc_agents.driving.environments import make_env
from esc_agents.driving.episodes import Episode
from esc_agents.driving.policies import load_policy
from esc_agents.driving.rule_driver import RuleDriver
from esc_agents.driving.vectorised import vectorise
from esc_agents.errors import UserError
from esc_agents.training import callbacks, run_directory
from esc_agents.training.models import ALGORITHMS, load_model, new_model
from esc_agents.training.run_directory import STEP
from esc_agents.training.train import train
from esc_gym.fastsim import Report
from tests.esc_agents.tiny import PPO as PPO_SETTINGS, SAC as SAC_SETTINGS, SAC_RUN, tiny

DRIVING = {
    f"driving/{name}"
    for name in ("return", "collision_rate", "mean_speed", "lane_changes", "vehicles_in_set")
}


def metrics(path):
    with (path / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def scalars(path):
    events = EventAccumulator(str(path / "tensorboard"))
    events.Reload()
    return {tag: events.Scalars(tag) for tag in events.Tags()["scalars"]}


@pytest.fixture(params=["ppo_run", "sac_run"])
def any_run(request):
    return request.getfixturevalue(request.param)


def test_files(any_run):
    names = {path.name for path in any_run.iterdir()}
    assert names == {
        "config.yaml", "command.txt", "versions.json", "wrapper.json", "metrics.csv", "tensorboard",
        "evaluations.npz", "best_model.zip", "checkpoints", "model.zip", "results.json", ".lock",
        "policy.safetensors", "policy.json", "best_policy.safetensors", "best_policy.json",
        "SHA256SUMS",
    }  # fmt: skip


def test_config_is_the_runs_own(ppo_run, sac_run):
    assert run_directory.open_run(ppo_run) == tiny(checkpoint_every=16)
    assert run_directory.open_run(sac_run) == tiny("lane-keeping-v0", algo="sac", **SAC_RUN)


def test_metrics_and_tensorboard_hold_what_is_named(any_run):
    rows, events = metrics(any_run), scalars(any_run)
    wanted = DRIVING | {"eval/return", "eval/collision_rate"}
    assert wanted | {"time/fps"} <= events.keys()
    assert not [name for name in rows[0] if name.startswith("time/") and name != STEP]
    assert wanted <= {key for row in rows for key, value in row.items() if value}
    assert int(rows[-1][STEP]) == run_directory.open_run(any_run).steps
    steps = [int(row[STEP]) for row in rows]
    assert steps == sorted(steps)


def test_driving_metrics_are_plausible(ppo_run):
    last = [row for row in metrics(ppo_run) if row["driving/return"]][-1]
    assert 0 <= float(last["driving/collision_rate"]) <= 1
    assert 15 < float(last["driving/mean_speed"]) < 40
    assert 0 < float(last["driving/vehicles_in_set"]) <= 6


def test_evaluations_are_on_the_fixed_seeds_at_the_asked_steps(any_run):
    saved = np.load(any_run / "evaluations.npz")
    steps = run_directory.open_run(any_run).steps
    expected = np.arange(1, 3) * (steps // 2)  # `every` is half the run in both
    np.testing.assert_array_equal(saved["timesteps"], expected)
    assert saved["results"].shape == saved["ep_lengths"].shape == (2, 1)


@pytest.mark.parametrize(("fixture", "algorithm"), [("ppo_run", PPO), ("sac_run", SAC)])
def test_model_loads_with_plain_sb3_and_drives(fixture, algorithm, request):
    path = request.getfixturevalue(fixture)
    config = run_directory.open_run(path)
    model = algorithm.load(path / "model.zip", device="cpu")
    assert model.num_timesteps == config.steps
    env = make_env(config)
    observation, _ = env.reset(seed=0)
    action, _ = model.predict(observation, deterministic=True)
    assert env.action_space.contains(action if action.shape else int(action))


def test_hyperparameters_reach_sb3(ppo_run, sac_run):
    ppo, sac = PPO.load(ppo_run / "model.zip"), SAC.load(sac_run / "model.zip")
    assert (ppo.n_steps, ppo.batch_size, ppo.n_epochs) == (16, 16, 1)
    assert (sac.learning_starts, sac.batch_size, sac.gamma) == (8, 8, 0.98)
    assert {k: v for k, v in PPO_SETTINGS.items() if k != "net_arch"}.items() <= vars(ppo).items()
    assert vars(sac)["buffer_size"] == SAC_SETTINGS["buffer_size"]
    assert ppo.policy.net_arch == sac.policy.net_arch == [8]


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_what_falls_falls_to_nothing(algo, tmp_path, monkeypatch, capsys):
    """Learning rate and entropy coefficient at each update, a quarter of the run apart."""
    rate = {"learning_rate": 4e-4, "learning_rate_schedule": "linear"}
    settings = {
        "ppo": {**PPO_SETTINGS, **rate, "ent_coef": 0.04, "ent_coef_schedule": "linear"},
        "sac": {**SAC_SETTINGS, **rate, "train_freq": 16, "learning_starts": 1},
    }  # fmt: skip
    seen = []

    class Spy(ALGORITHMS[algo]):
        def train(self, *args, **kwargs):
            super().train(*args, **kwargs)
            of = self.policy if algo == "ppo" else self.actor
            seen.append(of.optimizer.param_groups[0]["lr"])
            if algo == "ppo":
                assert self.ent_coef == pytest.approx(100 * seen[-1])

    monkeypatch.setitem(ALGORITHMS, algo, Spy)
    chosen = {"algo": algo, algo: settings[algo]}
    assert train(tiny(run_dir=tmp_path / "run", n_envs=1, steps=64, **chosen))
    assert seen == pytest.approx([3e-4, 2e-4, 1e-4, 0.0])
    assert "Nothing will be learned" not in capsys.readouterr().out


def test_wrapper_json_rebuilds_the_observation(ppo_run):
    saved = json.loads((ppo_run / "wrapper.json").read_text())
    names = ("max_vehicles", "features", "ego_features", "perception_distance", "frame", "ranges")
    rebuilt = gym.make(
        "esc_gym/highway-fast-v0",
        config=run_directory.open_run(ppo_run).env_config,
        **{name: saved[name] for name in names},
    )
    model = PPO.load(ppo_run / "model.zip", device="cpu")
    assert rebuilt.observation_space == model.observation_space
    assert (saved["max_vehicles"], saved["d1"]) == model.observation_space["vehicles"].shape
    assert (saved["d2"],) == model.observation_space["ego"].shape


def test_results_compare_with_the_blind_policies(ppo_run, sac_run):
    def names(path):
        return [row["policy"] for row in json.loads((path / "results.json").read_text())]

    meta = ["LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER"]
    blind = [f"always {action}" for action in meta]
    assert names(ppo_run) == ["esc", *blind, "random", "IDM/MOBIL", "planner, knows all"]
    assert names(sac_run) == ["esc", "always neutral", "random", "IDM/MOBIL"]


def test_the_rule_driver_drives_the_same_episodes(ppo_run):
    """Against one episode that is driven here."""
    env = make_env(tiny(), rule_driver=True)
    env.reset(seed=tiny().evaluation.seed)
    rewards, ended = [], False
    while not ended:
        _, reward, terminated, truncated, _ = env.step(0)
        rewards.append(reward)
        ended = terminated or truncated
    rows = {row["policy"]: row for row in json.loads((ppo_run / "results.json").read_text())}
    assert rows["IDM/MOBIL"]["reward"] == pytest.approx(sum(rewards))
    assert rows["IDM/MOBIL"]["length"] == len(rewards)


def test_a_rule_driver_that_cannot_drive_costs_its_row_only(tmp_path, monkeypatch, capsys):
    def broken(self, **options):
        raise KeyError("lane")

    monkeypatch.setattr(RuleDriver, "reset", broken)
    assert train(tiny(run_dir=tmp_path / "run"))
    why = "IDM/MOBIL is missing: evaluation, environment 0, episode 0, step 0: KeyError: 'lane'"
    assert why in capsys.readouterr().out.splitlines()
    rows = json.loads((tmp_path / "run" / "results.json").read_text())
    assert [row["policy"] for row in rows][-2:] == ["random", "planner, knows all"]


@pytest.mark.parametrize(("reward", "above"), [(-1000.0, True), (1000.0, False)])
def test_a_line_says_when_training_is_above_the_rule_driver(
    reward, above, tmp_path, monkeypatch, capsys
):
    drives = [Episode(0, reward, 1, False, 0.0, 0.0, 0.0, 0, 0.0, 1.0)] * 2
    monkeypatch.setattr("esc_agents.training.results.rule_driver", lambda *arguments: drives)
    assert train(tiny(run_dir=tmp_path / "run"))
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("step ")]
    assert lines
    assert all(line.endswith("; above IDM/MOBIL's -1000.00") == above for line in lines)


def test_training_learns_something_and_repeats_itself(ppo_run, tmp_path):
    assert train(tiny(run_dir=tmp_path / "again", checkpoint_every=16))
    one = load_policy(ppo_run)[0].state_dict()
    two = load_policy(tmp_path / "again")[0].state_dict()
    torch.manual_seed(0)
    untrained = vars(new_model(tiny(), vectorise(tiny(), 2)))["policy"].state_dict()
    moved = {name for name in one if not torch.equal(one[name], untrained[name])}
    assert any("features_extractor" in name for name in moved)
    for name in one:
        torch.testing.assert_close(one[name], two[name], rtol=0, atol=0)


def test_what_is_merged_in_training_only_is_in_no_evaluation(tmp_path):
    nothing = {name: 0 for name in ("collision_reward", "high_speed_reward", "right_lane_reward")}
    ppo = {**PPO_SETTINGS, "train_env_config": {**nothing, "normalize_reward": False}}
    assert train(tiny(run_dir=tmp_path / "run", ppo=ppo, steps=128))
    returns = {row["driving/return"] for row in metrics(tmp_path / "run")} - {""}
    assert {float(value) for value in returns} == {0.0}
    assert (np.load(tmp_path / "run" / "evaluations.npz")["results"] > 1).all()


def test_an_existing_directory_is_refused_and_left_alone(ppo_run):
    before = {path: path.stat().st_mtime_ns for path in ppo_run.rglob("*")}
    with pytest.raises(UserError, match="continue that run with esc-train --resume"):
        train(tiny(run_dir=ppo_run))
    assert {path: path.stat().st_mtime_ns for path in ppo_run.rglob("*")} == before


def test_an_existing_directory_names_the_program_that_continues_it(tmp_path):
    (tmp_path / "imitate.yaml").touch()
    with pytest.raises(UserError, match=f"with esc-imitate --resume {tmp_path},"):
        run_directory.check_free(tmp_path)


def test_resume_goes_on(own_run):
    before = [row[STEP] for row in metrics(own_run)]
    config = run_directory.open_run(own_run)
    assert train(config.model_copy(update={"steps": 96}), resume=own_run)
    assert PPO.load(own_run / "model.zip").num_timesteps == 96
    steps = [int(row[STEP]) for row in metrics(own_run)]
    assert [str(step) for step in steps[: len(before)]] == before
    assert steps[len(before) :] == sorted(steps[len(before) :])
    assert min(steps[len(before) :]) > 32
    timesteps = np.load(own_run / "evaluations.npz")["timesteps"]
    np.testing.assert_array_equal(timesteps, [16, 32, 48, 64, 80, 96])
    assert run_directory.open_run(own_run).steps == 96
    with pytest.raises(UserError, match="has 96 of 96 steps already; ask for more"):
        train(run_directory.open_run(own_run), resume=own_run)


def test_ctrl_c_saves_the_model_and_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def interrupt(self):
        if self.num_timesteps == 20:
            signal.raise_signal(signal.SIGINT)
        return True

    monkeypatch.setattr(callbacks.DrivingLog, "_on_step", interrupt)
    path = tmp_path / "run"
    assert not train(tiny(run_dir=path, steps=64))
    assert f"Continue with: esc-train --resume {path}" in capsys.readouterr().out
    assert not (path / "results.json").exists()
    assert PPO.load(path / "model.zip").num_timesteps == 32  # the rollout was gone through with
    monkeypatch.undo()
    assert train(run_directory.open_run(path), resume=path)
    assert PPO.load(path / "model.zip").num_timesteps >= 64


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"repr": "ecs"}, r"repr: unknown representation 'ecs'.*did you mean 'esc'"),
        ({"device": "meta"}, "device: expected auto, cpu or cuda, got 'meta'"),
        ({"device": "abacus"}, "device: expected auto, cpu or cuda, got 'abacus'"),
        ({"ppo": {**PPO_SETTINGS, "batch_size": 64}}, "at most n_steps .* = 32, got 64"),
        ({"ppo": {**PPO_SETTINGS, "use_sde": True}}, "expected continuous actions, got Discrete"),
        ({"env_config": {"lanes_cont": 2}}, "unknown key 'lanes_cont'; did you mean 'lanes_count'"),
        (
            {"env_config": {"collision_reward": "much"}},
            "highway-fast-v0: config.*expected a number",
        ),
        ({"env_config": {"action": {"target_speeds": []}}}, "highway-fast-v0: IndexError"),
        ({"ppo": {"train_env_config": {"lanes_cont": 2}}}, "unknown key 'lanes_cont'"),
        (
            {"ppo": {"train_env_config": {"vehicles_count": 9}}},
            r"vehicles \(6, 7\), got \(9, 7\); .* observation.max_ve",
        ),
        (
            {"ppo": {"train_env_config": {"action": {"type": "ContinuousAction"}}}},
            "the actions that evaluations have",
        ),
        (
            {"encoder": {"arguments": {"scala": 1}}},
            r"-v0: encoder \{scala: 1\}: .* takes .*scale; got scala",
        ),
        ({"encoder": {"hidden": ()}}, "hidden: expected at least one width"),
        ({"observation": {"features": ("x", "z")}}, r"expected distinct names .* got \['z'\]"),
        ({"observation": {"ranges": {"x": (1, 0)}}}, "low < high"),
        ({"repr": "fp", "observation": {"features": ("vx",)}}, "position"),
    ],
)
def test_refused_before_anything_is_made(changes, message, tmp_path):
    with pytest.raises(UserError, match=message):
        train(tiny(run_dir=tmp_path / "run", **changes))
    assert not list(tmp_path.iterdir())


def test_a_buffer_larger_than_memory(tmp_path):
    sac = {**SAC_SETTINGS, "buffer_size": 10**16}
    with pytest.raises(UserError, match=r"buffer_size.*Unable to allocate"):
        train(tiny("lane-keeping-v0", algo="sac", sac=sac, run_dir=tmp_path / "run"))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("representation", ["fp", "ap", "mean", "max", "attention"])
def test_check_accepts_every_representation(representation):
    wide = {"hidden": (64, 64)}  # narrow ones cannot be matched to 5 %, which warns
    env = check(tiny(repr=representation, encoder=wide))
    assert env.get_wrapper_attr("set_spec").max_vehicles == 6


def test_processes_of_their_own():
    one = vectorise(tiny("lane-keeping-v0", vec="subproc"), 1)
    try:
        assert isinstance(one, SubprocVecEnv)
        assert one.reset()["mask"].shape == (1, 1)
    finally:
        one.close()
    assert isinstance(vectorise(tiny("lane-keeping-v0", vec="auto"), 1), BatchVecEnv)


@pytest.mark.parametrize(("compiled", "expected"), [(1, DummyVecEnv), (0, list)])
def test_auto_takes_processes_where_the_simulation_is_not_compiled(compiled, expected, monkeypatch):
    monkeypatch.setattr("esc_agents.driving.vectorised.SubprocVecEnv", list)  # no process starts
    monkeypatch.setattr("esc_agents.driving.vectorised.report", lambda env: Report(compiled))
    monkeypatch.setattr(
        "esc_agents.driving.vectorised.unknown_to_engine", lambda config: "a road of one's own"
    )
    monkeypatch.setattr("os.sched_getaffinity", lambda process: {0, 1}, raising=False)
    assert isinstance(vectorise(tiny("lane-keeping-v0", vec="auto"), 2), expected)


def test_torch_computes_with_the_threads_asked_for(own_run):
    before = torch.get_num_threads()
    try:
        for threads in (2, 1):
            load_model(tiny(threads=threads), own_run)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
