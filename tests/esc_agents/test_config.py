import pytest
import yaml

from esc_agents.config import (
    TrainConfig,
    check_env_id,
    config_for_env,
    configs_folder,
    dump,
    load_config,
    scenarios,
)
from esc_agents.errors import UserError
from esc_agents.yaml_text import flow, parse
from esc_gym.registration import ENV_IDS
from tests.esc_agents.tiny import tiny


def load(text, tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text(text)
    return load_config(path)


@pytest.mark.parametrize("name", scenarios())
def test_shipped_scenarios_load(name):
    path = scenarios()[name]
    config = load_config(name)
    assert f"esc_gym/{config.env}" in ENV_IDS
    assert path.read_text().startswith(f"# esc-train --config {name} ")
    # What a file says is what comes out, whatever the defaults.
    values = yaml.safe_load(path.read_text())
    assert values.pop("schema") == 1
    for key, value in values.items():
        if not isinstance(value, dict):
            assert getattr(config, key) == value


def test_every_yaml_below_train_is_a_scenario():
    expected = {
        "highway", "highway-fast", "exit", "intersection", "merge", "roundabout", "two-way",
        "u-turn", "racetrack", "parking", "parking-goal", "lane-keeping",
        "highway-dense", "intersection-dense", "merge-dense",
    }  # fmt: skip
    assert set(scenarios()) == expected
    assert len(list((configs_folder() / "train").rglob("*"))) == len(expected)


@pytest.mark.parametrize(
    "config",
    [
        *(pytest.param(config_for_env(name), id=name) for name in scenarios()),
        tiny(seed=5, repr="pkg.mod:Class", algo="sac"),
        TrainConfig.model_validate(
            {
                "env_config": {"action": {"type": "ContinuousAction"}, "x": [1, None, "ü"]},
                "observation": {"ranges": {"x": (-1, 1e-7)}, "ego_features": ("speed",)},
                "encoder": {"arguments": {"scale": 0.1}},
                "ppo": {"learning_rate": 1e-5},
            }
        ),
    ],
)
def test_dump_reads_back_equal(config, tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text(dump(config))
    assert load_config(path, trust=True) == config


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stepz: 3", r"unknown key 'stepz'; did you mean 'steps'\?"),
        ("ppo: {learnin_rate: 1}", r"'ppo.learnin_rate'; did you mean 'learning_rate'\?"),
        ("continuous: {progress: 1}", r"'continuous.progress'; .*'progress_reward'"),
        ("observation: {zzz: 1}", "'observation.zzz'; expected one of max_vehicles, features"),
        ("steps: many", "steps should be .*integer.*'many'"),
        ("steps: 0", "steps should be .*greater than 0, got 0"),
        ("observation: {max_vehicles: 0}", "max_vehicles should be .*greater than 0, got 0"),
        ("seed: 4294967296", "seed should be .*less than 4294967296"),
        ("ppo: {gamma: 1.5}", "ppo.gamma should be .*less than or equal to 1, got 1.5"),
        ("n_envs: -1", "n_envs should be .*greater than 0, got -1"),
        ("ppo: {learning_rate: .inf}", "ppo.learning_rate should be .*finite"),
        ("env_config: 3", "env_config should be a mapping, got 3"),
        ("ppo: 3", "ppo should be a mapping, got 3"),
        ("seed: yes", "seed should be .*integer.*'yes'"),
        ("steps: 3\nsteps: 5", "not readable as YAML: 'steps' stands there twice"),
        ("env_config: {a: 1, a: 2}", "not readable as YAML: 'a' stands there twice"),
        ("algo: dqn", "algo should be .*'ppo' or 'sac', got 'dqn'"),
        ("1: 2", "string"),
        ("- env", "expected keys and values, got list"),
        ("", "expected keys and values, got NoneType"),
        ("env: [", "not readable as YAML"),
        ("env_config: {a: 2020-13-45}", "not readable as YAML: month must be in 1..12"),
        ("env_config: {a: !!bool maybe}", "not readable as YAML: a value is not of the type"),
        ("env_config: {a: !!int ''}", "not readable as YAML: a value is not of the type"),
        (
            "encoder: {arguments: {representation: fp, hidden: [3], scale: 2}}",
            r"encoder.arguments: .*only the encoder class has; .* say hidden, representation",
        ),
        ("env: !!python/object/apply:os.getcwd []", "not readable as YAML"),
    ],
)
def test_bad_files(text, message, tmp_path):
    with pytest.raises(UserError, match=message):
        load(text, tmp_path)


def test_numbers_that_yaml_reads_as_text(tmp_path):
    assert load("ppo: {learning_rate: 3e-4}", tmp_path).ppo.learning_rate == 0.0003
    # Where no type says that it is one.
    text = "env_config: {a: 1e-3, b: -2E+1, c: .5e1, d: 1.e2, e: '1e3', f: 1e, g: e1, h: 1e-3x}"
    config = load(text, tmp_path)
    values = [1e-3, -20.0, 5.0, 100.0, "1e3", "1e", "e1", "1e-3x"]
    assert list(config.env_config.values()) == values
    assert load(dump(config), tmp_path) == config
    assert parse(flow(config.env_config)) == config.env_config
    # And the other way round: a time of day and a leading zero are no numbers of YAML 1.2.
    other = parse("[1:30, 010, 0x1F, -5, 500_000, 1., .5, -.inf, yes, true]")
    assert other == ["1:30", "010", 31, -5, 500_000, 1.0, 0.5, float("-inf"), "yes", True]
    assert parse(flow(other)) == other
    assert [flow(value) for value in (80.0, "x", "1e3", [])] == ["80.0", "x", "'1e3'", "[]"]


def test_unknown_scenario(tmp_path):
    with pytest.raises(UserError, match=r"no such scenario; did you mean 'highway'\?"):
        load_config("higway")
    with pytest.raises(UserError, match="no file"):
        load_config(tmp_path)


def test_an_existing_file_wins_over_a_shipped_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "highway").write_text("steps: 7")
    assert load_config("highway").steps == 7


def test_env_by_id_and_by_scenario():
    assert config_for_env("highway-dense") == load_config("highway-dense")
    assert config_for_env("esc_gym/highway-v0") == load_config("highway")
    # Another version of an id has its family's scenario, under its own name.
    assert config_for_env("intersection-v1").env == "intersection-v1"
    assert config_for_env("intersection-v1").continuous == load_config("intersection").continuous
    assert config_for_env("racetrack-oval-v0") == TrainConfig(env="racetrack-oval-v0")


def test_env_that_is_none():
    with pytest.raises(UserError, match=r"'highway-v9'; did you mean 'highway-v0'\?"):
        config_for_env("highway-v9")
    with pytest.raises(UserError, match="multi-agent; expected one of the 28 single-agent"):
        check_env_id("intersection-multi-agent-v0")
    with pytest.raises(UserError, match="unknown environment"):
        check_env_id("CartPole-v1")


def test_configurations_do_not_change():
    with pytest.raises(ValueError, match="frozen"):
        TrainConfig().steps = 3  # type: ignore[misc]


def test_files_of_another_schema_are_refused(tmp_path):
    assert load("steps: 5", tmp_path).steps == 5
    with pytest.raises(UserError, match="expected schema 1, got 2; it is of another esc-gym"):
        load("schema: 2\nsteps: 5", tmp_path)
    assert dump(TrainConfig()).startswith("schema: 1\n")
