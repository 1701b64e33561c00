"""The console scripts: one line and exit code 2 for what a user can get wrong."""

import os
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch

from esc_agents.cli import _one_line, eval as eval_cli, guarded, train as train_cli
from esc_agents.config import load_config
from esc_agents.driving.checks import check
from esc_agents.driving.environments import in_training
from esc_agents.errors import UserError
from esc_agents.training.run_directory import open_run

FAST = [
    "--env", "lane-keeping", "--vec", "dummy", "--n-envs", "1", "--device", "cpu", "--steps", "16",
    "--ppo.n-steps", "16", "--ppo.batch-size", "16", "--evaluation.episodes", "1",
    "--encoder.hidden", "8",
]  # fmt: skip


def test_train_from_start_to_end(call, tmp_path):
    code, out, err = call(train_cli, *FAST, "--run-dir", "run")
    assert (code, err) == (0, "")
    assert "always neutral" in out
    assert "every policy that never looks" in out
    assert out.endswith("Run directory: run\n")
    assert open_run(tmp_path / "run").env == "lane-keeping-v0"
    command = (tmp_path / "run" / "command.txt").read_text()
    assert command.startswith("esc-train --env lane-keeping --vec dummy")

    code, out, err = call(train_cli, "--config", "run/config.yaml", "--run-dir", "twin")
    assert (code, err) == (0, "")
    assert open_run(tmp_path / "twin") == open_run(tmp_path / "run")

    code, out, err = call(train_cli, "--resume", "run", "--steps", "32")
    assert (code, err) == (0, "")
    assert "32 steps into run" in out


def parsed(monkeypatch, *args):
    """The configuration that a command line leads to."""
    configs = []
    monkeypatch.setattr(
        "esc_agents.training.train.train", lambda config, **options: configs.append(config)
    )
    train_cli.command([str(arg) for arg in args])
    return configs[0]


@pytest.mark.parametrize("allocate", [np.empty, torch.empty])
def test_too_little_memory_is_one_line(allocate, capsys):
    with pytest.raises(SystemExit, match="2"):
        guarded("esc-train", lambda: allocate(10**15))
    error = capsys.readouterr().err
    assert error.startswith("esc-train: not enough memory: ")
    assert error.endswith("; ask for less\n")
    assert error.count("\n") == 1


def test_another_error_is_told_whole():
    def command():
        raise RuntimeError("of another kind")

    with pytest.raises(RuntimeError, match="of another kind"):
        guarded("esc-train", command)


@pytest.mark.parametrize("word", ["1e6", "1000000", "1_000_000", "1000000.0", "+1E+6"])
def test_a_million_steps_is_written_as_people_write_it(monkeypatch, word):
    config = parsed(monkeypatch, "--steps", word, "--evaluation.every", word)
    assert (config.steps, config.evaluation.every) == (1_000_000, 1_000_000)


def test_flags_override_the_scenario(monkeypatch):
    config = parsed(
        monkeypatch, "--env", "highway-dense", "--observation.max-vehicles", "7", "--seed", "3",
        "--env-config", "{lanes_count: 2}", "--encoder.arguments", "{scale: 0.1}",
        "--ppo.train-env-config", "{collision_reward: -9}",
    )  # fmt: skip
    assert (config.env, config.seed, config.observation.max_vehicles) == ("highway-v0", 3, 7)
    assert config.env_config["lanes_count"] == 2
    assert config.env_config["vehicles_count"] == 40  # what the scenario says stays
    own = load_config("highway-dense").ppo.train_env_config
    assert "high_speed_reward" in own
    assert config.ppo.train_env_config == {**own, "collision_reward": -9}
    assert config.observation.ranges["x"] == (-30.0, 30.0)
    assert config.encoder.arguments == {"scale": 0.1}


def test_the_env_config_that_is_given_beats_the_recipe_in_training_too(monkeypatch):
    given = "{collision_reward: -20, vehicles_density: 0.6}"
    config = parsed(
        monkeypatch, "--env", "highway-dense", "--env-config", given,
        "--ppo.train-env-config", "{collision_reward: -9}",
    )  # fmt: skip
    for each in (config, in_training(config)):
        assert each.env_config["vehicles_density"] == 0.6
    assert config.env_config["collision_reward"] == -20
    assert in_training(config).env_config["collision_reward"] == -9
    own = load_config("highway-dense").ppo.train_env_config
    assert in_training(config).env_config["high_speed_reward"] == own["high_speed_reward"]


def test_a_scenario_in_a_file_is_no_id(monkeypatch, tmp_path):
    file = tmp_path / "own.yaml"
    file.write_text("env: highway-dense\n")
    with pytest.raises(UserError, match="expected a highway-env id, got a scenario; give --env"):
        check(parsed(monkeypatch, "--config", file))


def test_steps_of_the_other_algorithm(monkeypatch, tmp_path):
    """A scenario's steps are PPO's, and continuous.steps SAC's; a file's are what it says."""
    ppo, sac = load_config("highway").steps, load_config("highway").continuous.steps
    for args, steps in {
        ("--algo", "ppo"): ppo, ("--algo", "sac"): sac, ("--algo", "sac", "--steps", 7): 7,
    }.items():  # fmt: skip
        assert parsed(monkeypatch, "--env", "highway", *args).steps == steps
    file = tmp_path / "own.yaml"
    file.write_text("algo: sac\nsteps: 9\ncontinuous: {steps: 11}\n")
    assert parsed(monkeypatch, "--config", file, "--algo", "sac").steps == 9
    assert sac < ppo


def test_nested_env_config_is_merged(monkeypatch):
    config = parsed(
        monkeypatch, "--env", "merge-dense", "--env-config", "{action: {longitudinal: false}}"
    )
    assert config.env_config["action"].keys() >= {"type", "target_speeds", "longitudinal"}


def test_the_command_line_wins_over_what_sac_changes(monkeypatch):
    given = "{collision_reward: -77, action: {type: ContinuousAction, lateral: false}}"
    config = parsed(monkeypatch, "--env", "highway", "--algo", "sac", "--env-config", given)
    changed = config.continuous.env_config
    assert changed["collision_reward"] == -77
    assert changed["action"]["lateral"] is False
    assert changed["action"]["steering_range"]
    assert changed["policy_frequency"] == 5


def test_continuous_settings_have_flags(monkeypatch):
    config = parsed(
        monkeypatch, "--env", "highway", "--algo", "sac", "--continuous.progress-reward", "0.5"
    )
    assert config.continuous.progress_reward == 0.5
    assert config.continuous.offroad_terminal is True


@pytest.mark.parametrize("script", [train_cli, eval_cli])
def test_help(script, call):
    code, out, err = call(script, "--help")
    assert (code, err) == (0, "")
    assert f"usage: {script.PROGRAM}" in out


ON_OVERFLOW = ["--observation.on-overflow", "error"]
BAD_TRAIN = {
    "unknown env": (["--env", "highway-v9"], "did you mean 'highway-v0'?"),
    "empty env": (["--env", ""], "unknown environment"),
    "multi-agent env": (["--env", "intersection-multi-agent-v0"], "multi-agent"),
    "unknown repr": (["--repr", "ecs"], "did you mean 'esc'?"),
    "module without class": (["--repr", "os:path"], "subclass of SetEncoder"),
    "too many environments": (["--n-envs", "1e9"], "less than or equal to 65536, got 1000000000"),
    "too many threads": (["--threads", "1e4"], "less than or equal to 1024"),
    "too many episodes": (["--evaluation.episodes", "1e9"], "less than or equal to 1000000"),
    "too wide a network": (["--ppo.net-arch", "64", "1e5"], "less than or equal to 8192"),
    "too wide an encoder": (["--encoder.hidden", "1e5"], "less than or equal to 8192"),
    "a word for a width": (["--ppo.net-arch", "64", "a"], "what --help says, got '64', 'a'"),
    "unknown key": (["--config", "key.yaml"], "unknown key 'step'; did you mean 'steps'?"),
    "wrong type": (["--config", "type.yaml"], "got 'many'"),
    "a list": (["--config", "list.yaml"], "expected keys and values, got list"),
    "no YAML": (["--config", "broken.yaml"], "not readable as YAML"),
    "missing file": (["--config", "missing.yaml"], "no file 'missing.yaml'"),
    "scenario beside config": (["--config", "highway", "--env", "merge"], "expected a highway-env"),
    "existing directory": (["--run-dir", "list.yaml"], "already exists"),
    "directory in a file": (["--run-dir", "list.yaml/run"], "no directory can be made"),
    "no steps": (["--steps", "0"], "greater than 0, got 0"),
    "word for a number": (["--steps", "many"], "expected a whole number below 2^63, got 'many'"),
    "half a step": (["--steps", "1.5e0"], "expected a whole number below 2^63, got '1.5e0'"),
    "endless": (["--steps", "inf"], "expected a whole number below 2^63, got 'inf'"),
    "far too many": (["--n-envs", "1e30"], "expected a whole number below 2^63, got '1e30'"),
    "half an optional step": (["--evaluation.every", "1.5"], "below 2^63, or None, got '1.5'"),
    "missing value": (["--steps"], "Missing value"),
    "missing scenario": (["--env"], "expected one argument"),
    "negative n_envs": (["--n-envs", "-1"], "n_envs"),
    "unknown flag": (["--stepz", "3"], "did you mean --steps?"),
    "unknown algorithm": (["--algo", "dqn"], "'dqn'"),
    "sac on merge": (["--env", "merge", "--algo", "sac"], "cannot do continuous actions here"),
    "sac, discrete": (["--config", "discrete.yaml"], "expected continuous actions, got Discrete"),
    "no rows": (["--observation.max-vehicles", "0"], "observation.max_vehicles"),
    "unknown feature": (["--observation.features", "x", "z"], "got ['z']"),
    "overflow": (
        ["--env", "highway-fast", "--observation.max-vehicles", "1", *ON_OVERFLOW],
        "max_vehicles=1",
    ),
    "device": (["--device", "abacus"], "got 'abacus'"),
    "no code": (["--encoder.code-dim", "0"], "encoder.code_dim"),
    "encoder argument": (["--encoder.arguments", "{scala: 1}"], "scale; got scala"),
    "batch size": (["--ppo.batch-size", "64"], "at most n_steps * n_envs = 16, got 64"),
    "env_config no mapping": (["--env-config", "3"], "env_config should be a mapping, got 3"),
    "env_config no YAML": (["--env-config", "{"], "expected YAML"),
    "env_config unknown": (["--env-config", "{lane_width: 3}"], "unknown key 'lane_width'"),
    "env_config observation": (["--env-config", "{observation: {}}"], "has no effect here"),
    "resume nothing": (["--resume", "missing"], "expected a config.yaml"),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_TRAIN)
def test_bad_input_of_train(name, call, tmp_path):
    args, message = BAD_TRAIN[name]
    files = {
        "key": "step: 5", "type": "steps: many", "list": "- 1", "broken": "a: [1\nb: {",
        "discrete": "{env: highway-fast-v0, algo: sac}",
    }  # fmt: skip
    for stem, text in files.items():
        (tmp_path / f"{stem}.yaml").write_text(text)
    # --config decides everything, --resume too: there FAST would be more than one mistake.
    before = [] if {"--config", "--resume"} & set(args) else [*FAST, "--run-dir", "run"]
    code, out, err = call(train_cli, *before, *args)
    assert (code, out) == (2, "")
    assert err.startswith("esc-train: ")
    assert err.count("\n") == 1
    assert message in err
    assert "Traceback" not in err
    assert len(err) < 1200
    assert {path.stem for path in tmp_path.iterdir()} == files.keys()


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["--seed", "3"], "got seed"),
        (["--env", "highway-v0"], "got env"),
        (["--algo", "sac"], "got algo"),
        (["--env-config", "{lanes_count: 2}"], "got env_config"),
        (["--run-dir", "other"], "got run_dir"),
        ([], "has 32 of 32 steps already; ask for more with --steps"),
        (["--steps", "16"], "has 32 of 16 steps already"),
    ],
)
def test_resume_takes_more_steps_and_nothing_else(args, message, call, own_run):
    before = {path: path.stat().st_mtime_ns for path in own_run.rglob("*")}
    code, out, err = call(train_cli, "--resume", own_run, *args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert {path: path.stat().st_mtime_ns for path in own_run.rglob("*")} == before


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "expected a run directory, or --pretrained"),
        (["missing", "--pretrained", "merge"], "or --expert NAME, got 2 of them"),
        (["missing"], "missing is no run directory"),
        (["."], "expected a config.yaml"),
        (["missing", "--episodes", "0"], "episodes"),
        (["missing", "--episodes"], "Missing value"),
        (["missing", "--film"], "Unrecognized"),
        (["missing", "--planner.horizon", "3"], "--planner: expected --expert planner"),
        (["missing", "--expert", "idm"], "got 2 of them"),
        (["--expert", "mcts", "--env", "merge"], "invalid choice 'mcts'"),
        (["--expert", "planner"], "--expert planner: expected --env"),
        (
            ["--expert", "planner", "--env", "merge", "--planner.horizon", "1"],
            "--planner.free: expected at most the horizon, 1, got 2",
        ),
        (["--expert", "planner", "--env", "merg"], "did you mean 'merge'?"),
        (["--expert", "planner", "--env", "merge", "--shuffle"], "--shuffle: expected a trained"),
        (["--expert", "planner", "--env", "merge", "--planner.continuations", "UP"], "got 'UP'"),
        (["--expert", "idm", "--env", "parking", "--video", "v"], "a parking lot"),
        (["--expert", "idm", "--env", "parking"], "expected lanes to follow, got a parking"),
        (["--expert", "idm", "--env", "merge", "--planner.horizon", "3"], "got --expert idm"),
    ],
)
def test_bad_input_of_eval(args, message, call, tmp_path):
    code, out, err = call(eval_cli, *args)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("parking method tree", "expected an environment with meta-actions"),
        ("parking free 2", "--planner.free: the method cross-entropy has none; leave it out"),
        ("merge method cross-entropy", "expected an environment with continuous actions, got"),
        ("merge samples 64", "--planner.samples: the method look-ahead has none; leave it out"),
        ("merge futures 2", "planner.futures needs knows: observed"),
        ("merge policy gone", "gone is no run directory"),
        ("merge policy zoo:marge", "did you mean 'merge'?"),
        ("merge policy zoo:roundabout", "zoo:roundabout: expected a run with the same observation"),
    ],
)
def test_bad_planners(flags, message, call, tmp_path):
    env, name, value = flags.split()
    code, out, err = call(
        eval_cli, "--expert", "planner", "--env", env, f"--planner.{name}", value, "--video", "v"
    )
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert message in err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "framed",
    [
        # As tyro draws on a colour terminal, with UTF-8 without colour, and with ASCII alone.
        "\x1b[31m╭─\x1b[0m\x1b[31m Unrecognized options \x1b[0m\x1b[31m──╮\x1b[0m\n"
        "\x1b[31m│\x1b[0m \x1b[1mUnrecognized\x1b[0m options: --stepz \x1b[31m│\x1b[0m\n"
        "\x1b[31m│\x1b[0m \x1b[31m─────────────\x1b[0m \x1b[31m│\x1b[0m\n"
        "\x1b[31m│\x1b[0m Perhaps you meant: \x1b[31m│\x1b[0m\n"
        "\x1b[31m│\x1b[0m     \x1b[1m--steps\x1b[0m INT \x1b[31m│\x1b[0m\n"
        "\x1b[31m╰──╯\x1b[0m\n",
        "╭─ Unrecognized options ──╮\n│ Unrecognized options: --stepz │\n│ ────────────── │\n"
        "│ Perhaps you meant: │\n│     --steps INT │\n│ ────────────── │\n│ For help │\n╰──╯\n",
        "+- Unrecognized options --+\n| Unrecognized options: --stepz |\n| -------------- |\n"
        "| Perhaps you meant: |\n|     --steps INT |\n+-------------------------+\n",
    ],
)
def test_boxes_come_down_to_one_line(framed):
    assert _one_line(framed) == "Unrecognized options: --stepz; did you mean --steps?"


SCRIPT = "import sys; from esc_agents.cli.train import main; main()"


@pytest.mark.slow
def test_ctrl_c_with_worker_processes(tmp_path):
    args = [*FAST, "--vec", "subproc", "--steps", "1000000", "--run-dir", "run"]
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *args], cwd=tmp_path, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    ) as process:  # fmt: skip
        while "steps into" not in process.stdout.readline():
            assert process.poll() is None
        while not (tmp_path / "run" / "metrics.csv").exists():
            assert process.poll() is None
        os.killpg(process.pid, signal.SIGINT)  # the terminal sends it to the workers as well
        out, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (130, "")
    assert "the model is saved" in out
    assert out.endswith("Continue with: esc-train --resume run\n")
    assert (tmp_path / "run" / "model.zip").is_file()
