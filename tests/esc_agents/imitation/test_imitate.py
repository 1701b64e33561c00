"""A run of esc-imitate: its rounds, its files, a kill at any moment, and PPO after it."""

import json
import pkgutil
import re
import shutil
import signal

import numpy as np
import pytest
import torch

from esc_agents.cli import eval as eval_cli, imitate as imitate_cli, train as train_cli
from esc_agents.driving.batch import BatchVecEnv
from esc_agents.driving.environments import make_env, wrapper_json
from esc_agents.driving.planner_config import PlannerConfig
from esc_agents.driving.policies import load_policy
from esc_agents.errors import UserError
from esc_agents.imitation import collect, datasets, imitate, labels
from esc_agents.imitation.experts import expert_of
from esc_agents.imitation.imitate import open_imitation
from esc_agents.imitation.labels import Labels
from esc_agents.imitation.learning import fit, measure
from esc_agents.training import run_directory
from esc_gym.planning import LookAhead
from tests.esc_agents.imitation.small import OBSERVATION, PLANNER, gathered, small
from tests.esc_agents.training.test_instants import files_of
from tests.esc_agents.training.test_resume import Killed, kill


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    path = tmp_path_factory.mktemp("imitation") / "run"
    assert imitate.imitate(small(run_dir=path))
    return path


def weights(folder, name="policy"):
    return load_policy(folder, "cpu", name)[0].state_dict()


def weights_of(policy):
    return {name: tensor.clone() for name, tensor in policy.state_dict().items()}


def test_rounds(whole):
    """The first is driven by the planner, with noise; in the second the learner's own drive."""
    first, second = (labels.load(whole / "labels" / f"{number:03d}.npz") for number in range(2))
    assert min(len(Labels.of(drives)) for drives in (first, second)) >= 20
    seeds = [drive.seed for drive in [*first, *second]]
    assert len(set(seeds)) == len(seeds)
    assert min(seeds) >= 10**7  # evaluations begin at 1,000,000 and 2,000,000
    learner, _ = load_policy(whole / "rounds", "cpu", "000")
    for drive in second:
        seen = {name: part[:-1] for name, part in drive.observations.items()}
        np.testing.assert_array_equal(drive.actions, learner.predict(seen, deterministic=True)[0])
    last, policy = weights(whole / "rounds", "001"), weights(whole)
    assert all(torch.equal(last[name], policy[name]) for name in policy)
    assert not all(torch.equal(t, policy[n]) for n, t in weights(whole / "rounds", "000").items())


def test_metrics_are_of_what_was_held_out(whole):
    header, *rows = (whole / "metrics.csv").read_text().splitlines()
    drives = [d for n in range(2) for d in labels.load(whole / "labels" / f"{n:03d}.npz")]
    policy, steps = load_policy(whole)
    expected = measure(policy, Labels.of(labels.split(drives)[1]))
    row = dict(zip(header.split(","), rows[-1].split(","), strict=True))
    assert len(rows) == 2
    assert float(row["imitation/regret"]) == pytest.approx(expected.regret)
    assert int(row["time/total_timesteps"]) == steps == sum(len(d.actions) for d in drives)


def test_results(whole):
    rows = [row["policy"] for row in json.loads((whole / "results.json").read_text())]
    assert (rows[0], rows[-2:]) == ("esc", ["IDM/MOBIL", "planner, knows all"])


MOMENTS = {
    "in the first labels": ("esc_agents.imitation.labels.check_faults", 3),
    "before the labels are written": ("esc_agents.imitation.labels.save", 1),
    "in the first training": ("esc_agents.imitation.learning.logits", 2),
    "before the policy is written": ("esc_agents.imitation.imitate.save_policy", 1),
    "between the policy's files": ("esc_agents.files.write_text", 7),
    "in the second round": ("esc_agents.imitation.labels.save", 2),
    "before the last policy": ("esc_agents.imitation.imitate.save_policy", 3),
    "in the evaluation": ("esc_agents.training.results.blind_policies", 1),
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_killed_and_resumed(moment, whole, tmp_path, monkeypatch):
    path, call = MOMENTS[moment]
    owner, _, name = path.rpartition(".")
    kill(monkeypatch, pkgutil.resolve_name(owner), name, call)
    run = tmp_path / "run"
    with pytest.raises(Killed):
        imitate.imitate(small(run_dir=run))
    monkeypatch.undo()
    assert imitate.imitate(open_imitation(run), resume=run)
    assert files_of(run) == files_of(whole)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("place", ["labels.check_faults", "learning.logits"])
def test_stopped_by_a_signal_and_resumed(number, place, whole, tmp_path, monkeypatch, capsys):
    owner, _, name = f"esc_agents.imitation.{place}".rpartition(".")
    original = getattr(pkgutil.resolve_name(owner), name)
    calls = []

    def interrupted(*args):
        calls.append(None)
        if len(calls) == 2:
            signal.raise_signal(number)
        return original(*args)

    monkeypatch.setattr(pkgutil.resolve_name(owner), name, interrupted)
    run = tmp_path / "run"
    assert not imitate.imitate(small(run_dir=run))
    monkeypatch.undo()
    assert f"continue with: esc-imitate --resume {run}" in capsys.readouterr().out
    assert not (run / "results.json").exists()
    assert imitate.imitate(open_imitation(run), resume=run)
    assert files_of(run) == files_of(whole)


def test_from_a_data_set(tmp_path, call):
    """Cloning by itself, on the observation of the scenario, and then rounds with an expert."""
    collect.collect(gathered(episodes=12), tmp_path / "data-v0")
    flags = ["--env", "highway-fast", "--data", "data-v0", "--epochs", "1", "--device", "cpu"]
    flags += ["--env-config", "{vehicles_count: 6, duration: 6, lanes_count: 3}"]
    code, out, err = call(imitate_cli, *flags, "--run-dir", "clone")
    assert (code, err) == (0, "")
    assert "round 0: " in out
    assert "round 1: " not in out
    assert not (tmp_path / "clone" / "labels").exists()
    rounds = ["--expert", "planner", "--planner.horizon", "2", "--rounds", "1", "--labels", "9"]
    code, out, err = call(imitate_cli, *flags, *rounds, "--run-dir", "more")
    assert (code, err) == (0, "")
    assert "round 1: the learner drove" in out


def test_portions_are_learned_anew_and_judged_alike(tmp_path, monkeypatch):
    """The last portion is what one learns from all; whoever is killed between two goes on."""
    collect.collect(gathered(episodes=20, observation=OBSERVATION), tmp_path / "data-v0")
    values = {"expert": None, "data": tmp_path / "data-v0", "rounds": None}
    parts = small(**values, portions=3, run_dir=tmp_path / "parts")
    seen = []
    monkeypatch.setattr(
        "esc_agents.imitation.imitate.fit",
        lambda policy, learnt, config, seed, stop: seen.append(weights_of(policy)) or fit(
            policy, learnt, config, 2, stop
        ),
    )  # fmt: skip
    assert imitate.imitate(parts)
    assert len(seen) == 3
    assert all(torch.equal(seen[0][name], other[name]) for other in seen for name in seen[0])
    drives = datasets.read(tmp_path / "data-v0", wrapper_json(make_env(parts.train_config())), 5)
    counts = [sum(len(drive.actions) for drive in drives[:count]) for count in (5, 10, 20)]
    found = run_directory.read_metric(tmp_path / "parts", "time/total_timesteps")
    assert found == counts
    held_out = Labels.of(labels.split(drives)[1])
    regrets = run_directory.read_metric(tmp_path / "parts", "imitation/regret")
    for number, regret in enumerate(regrets):
        policy = load_policy(tmp_path / "parts" / "rounds", "cpu", f"{number:03d}")[0]
        assert measure(policy, held_out).regret == pytest.approx(regret)
    assert imitate.imitate(small(**values, run_dir=tmp_path / "whole"))
    whole, last = weights(tmp_path / "whole"), weights(tmp_path / "parts")
    assert all(torch.equal(whole[name], last[name]) for name in whole)


def test_portions_killed_and_resumed(tmp_path, monkeypatch):
    collect.collect(gathered(episodes=20, observation=OBSERVATION), tmp_path / "data-v0")
    config = small(expert=None, data=tmp_path / "data-v0", rounds=None, portions=3)
    assert imitate.imitate(config.model_copy(update={"run_dir": tmp_path / "whole"}))
    kill(monkeypatch, imitate, "save_policy", 4)  # each portion's, and the best
    run = tmp_path / "run"
    with pytest.raises(Killed):
        imitate.imitate(config.model_copy(update={"run_dir": run}))
    monkeypatch.undo()
    assert imitate.imitate(open_imitation(run), resume=run)
    assert files_of(run) == files_of(tmp_path / "whole")


def test_what_takes_a_run_takes_it(whole, call, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    assert (tmp_path / "run/config.yaml").read_text().startswith("# esc-imitate: imitate.yaml\n")
    code, out, err = call(eval_cli, "run", "--episodes", "2")
    assert (code, err) == (0, "")
    assert re.search(r", imitation, [\d,]+ labels; ", out)
    flags = ["--env", "highway-fast", "--start-from", "run", "--run-dir", "on", "--steps", "64"]
    road = ["--env-config", "{vehicles_count: 6, duration: 6, lanes_count: 3}"]
    ranges = "{x: [-100, 100], y: [-12, 12], vx: [-20, 20], vy: [-5, 5]}"
    network = ["--observation.ranges", ranges, "--encoder.hidden", "8", "--encoder.code-dim", "200"]
    observation = ["--observation.features", "x", "y", "vx", "vy", "cos_h", "sin_h", "obstacle"]
    distance = ["--observation.perception-distance", "200"]
    code, out, err = call(train_cli, *flags, *road, *network, *observation, *distance)
    assert (code, err) == (0, "")
    assert "Beginning with the weights of run\n" in out
    assert "Nothing will be learned: these are no more steps than one rollout has" in out
    code, _, err = call(train_cli, "--resume", "run")
    assert (code, err.count("\n")) == (2, 1)
    assert "run is a run of esc-imitate: continue it with esc-imitate --resume" in err
    assert "with esc-train --start-from run\n" in call(imitate_cli, "--resume", "run")[2]


def test_experts_of_other_actions_or_without_a_meaning(sac_run, whole, tmp_path):
    config, planner = small().train_config(), PlannerConfig()
    with pytest.raises(UserError, match=r"expected a run with the actions Discrete\(5\), got Box"):
        expert_of(f"run:{sac_run}", planner, config)
    shutil.copytree(whole, tmp_path / "run")
    (tmp_path / "run" / "policy.json").write_text("{")
    damaged = r"policy\.json is damaged or of another version: Invalid JSON"
    with pytest.raises(UserError, match=damaged):
        expert_of(f"run:{tmp_path / 'run'}", planner, config)


def test_the_policy_of_a_run_is_an_expert(whole):
    """Its own choice is worth 1; who learned from another observation cannot label."""
    config = small().train_config()
    expert = expert_of(f"run:{whole}", PlannerConfig(), config)
    envs = BatchVecEnv(config, 4, evaluation=True)
    observations = envs.reset()
    found = expert(envs, observations, np.array([2, 0]))
    chosen, _ = load_policy(whole)[0].predict(
        {name: part[[2, 0]] for name, part in observations.items()}, deterministic=True
    )
    np.testing.assert_array_equal(found, np.eye(5)[chosen])
    other = small(observation={"perception_distance": 50}).train_config()
    with pytest.raises(UserError, match="same observation, got perception_distance"):
        expert_of(f"run:{whole}", PlannerConfig(), other)


def test_a_planner_whose_plans_a_run_goes_on_with(whole):
    """It drives on as the run does: beside a planner that is given the run's policy."""
    config = small().train_config()
    look_ahead = PlannerConfig(horizon=4, free=1, continuations=("IDLE",), policy=str(whole))
    expert = expert_of("planner", look_ahead, config)
    envs = BatchVecEnv(config, 4, evaluation=True)
    observations = envs.reset()
    policy = load_policy(whole)[0]
    planner = LookAhead(
        horizon=4, free=1, continuations=("IDLE",),
        policy=lambda seen: policy.predict(seen, deterministic=True)[0],
    )  # fmt: skip
    found = expert(envs, observations, np.arange(4))
    np.testing.assert_array_equal(found, planner.values(envs.envs))
    other = small(observation={"perception_distance": 50}).train_config()
    with pytest.raises(UserError, match="same observation, got perception_distance"):
        expert_of("planner", look_ahead, other)


def test_it_begins_with_the_weights_of_another_run(whole, tmp_path, capsys):
    """Nothing is learned with a rate of nearly nothing: what it was is what it is."""
    config = small(start_from=str(whole), learning_rate=1e-30, rounds=0, run_dir=tmp_path / "on")
    assert imitate.imitate(config)
    assert f"Beginning with the weights of {whole}" in capsys.readouterr().out
    ours, theirs = (load_policy(folder)[0].state_dict() for folder in (tmp_path / "on", whole))
    assert all(torch.equal(ours[name], theirs[name]) for name in theirs)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ("", "expected --expert NAME, who labels, or --data DIR, of esc-collect"),
        ("--expert oracle", "expert: expected planner, idm, run:DIR or run:zoo:NAME, got 'oracle'"),
        ("--data nowhere", "data: no data set in nowhere"),
        ("--expert planner --portions 2", "portions: expected --data DIR, of which they are"),
        ("--data nowhere --rounds 2", "rounds: expected --expert, who labels"),
        ("--expert idm --planner.horizon 3", "--planner: expected --expert planner beside it"),
        ("--env parking --expert idm", "idm: parking-v0: expected an environment with meta-act"),
        ("--expert planner --repr max-pool", "repr: "),
        ("--resume nowhere", "nowhere is no run of esc-imitate: expected imitate.yaml in it; "),
        ("--expert planner --loss mse", "mse"),
    ],
)
def test_what_users_get_wrong(flags, message, call, tmp_path):
    flags = flags if "--env" in flags or "--resume" in flags else f"--env highway-fast {flags}"
    code, out, err = call(imitate_cli, *flags.split())
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_resume_takes_no_other_values(whole, call, tmp_path):
    shutil.copytree(whole, tmp_path / "run")
    code, _, err = call(imitate_cli, "--resume", "run", "--epochs", "3")
    assert (code, err.count("\n")) == (2, 1)
    assert "expected only --trust beside it, got epochs" in err
    assert PLANNER["horizon"] == open_imitation(tmp_path / "run").planner.horizon


def test_who_wrote_a_run(whole, tmp_path, monkeypatch):
    """A representation of one's own needs no trust; in what others wrote it does."""
    own = "tests.esc_agents.imitation.own:Own"
    kill(monkeypatch, imitate, "save_policy", 3)
    run = tmp_path / "run"
    with pytest.raises(Killed):
        imitate.imitate(small(run_dir=run, repr=own))
    monkeypatch.undo()
    text = (run / "imitate.yaml").read_text()
    assert imitate.imitate(open_imitation(run), resume=run)
    (run / "imitate.yaml").write_text(text.replace("epochs: 2", "epochs: 1"))
    with pytest.raises(UserError, match=r"names 'tests\.esc_agents\.imitation\.own:Own'"):
        open_imitation(run)
    assert open_imitation(run, trust=True).repr == own


def test_a_full_disk(tmp_path, monkeypatch):
    def full(*args):
        raise OSError(28, "No space left on device", "labels")

    monkeypatch.setattr(labels, "save", full)
    with pytest.raises(UserError, match=r"No space left .* continue with esc-imitate --resume"):
        imitate.imitate(small(run_dir=tmp_path / "run"))
