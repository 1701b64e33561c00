import pytest

from esc_agents.compare.grid import (
    Candidate,
    Cell,
    CompareConfig,
    candidates,
    check_transfer,
    imitate_config,
    scenario,
    study_cells,
    train_config,
    tuning_cells,
)
from esc_agents.config import config_for_env
from esc_agents.driving.environments import env_config, in_training
from esc_agents.errors import UserError
from esc_agents.tuning import settings as tune_settings
from esc_agents.tuning.settings import TuneConfig
from tests.esc_agents.compare.small import ENV, MORE, small


def test_every_run_has_a_name_of_its_own():
    config = small(env=(ENV, "merge-dense"), repr=("esc", "fp", "tests.x:Y"), seeds=3)
    cells = [*study_cells(config), *tuning_cells(config)]
    # 2 scenarios x 3 representations x 3 seeds; other traffic: 1 x 3; candidates: 2 x 3 x 2.
    assert len(cells) == 18 + 3 + 12
    assert len({(cell.task, cell.tuning, cell.name) for cell in cells}) == len(cells)
    assert not any(set(cell.name) & set(":/\\ ") for cell in cells)


def test_one_seed_of_everything_comes_before_the_next():
    cells = study_cells(small(seeds=3, transfer={}))
    assert [(cell.seed, cell.repr) for cell in cells[:3]] == [(0, "esc"), (0, "fp"), (1, "esc")]


def test_tuning_uses_other_seeds_and_episodes_and_the_same_candidates_for_all():
    config = small(repr=("esc", "fp", "attention"))
    tuning, study = tuning_cells(config), study_cells(config)
    assert not {cell.seed for cell in tuning} & {cell.seed for cell in study}
    tried = {r: [c.candidate for c in tuning if c.repr == r] for r in config.repr}
    assert tried["esc"] == tried["fp"] == tried["attention"] == candidates(config.tuning)
    episodes = {train_config(config, cell, 20).evaluation.seed for cell in tuning}
    assert episodes == {3_000_000}
    assert {train_config(config, cell, 20).evaluation.seed for cell in study} == {1_000_000}


def test_nothing_to_tune():
    assert tuning_cells(small(tuning={"seeds": 0})) == []
    assert candidates(small(tuning={"seeds": 0}).tuning) == [Candidate()]
    assert tuning_cells(small(tuning={"scales": [1.0], "learning_rates": [1.0]})) == []


def test_representations_differ_in_nothing_but_themselves():
    config = small(repr=("esc", "fp", "ap", "attention"))
    cells = [Cell(ENV, "ppo", repr, 1, candidate=Candidate(2.0, 0.1)) for repr in config.repr]
    runs = [train_config(config, cell, 7).model_dump() for cell in cells]
    arguments = [run["encoder"].pop("arguments") for run in runs]
    assert arguments == [{"scale": 0.1}, *[{"scale": 0.1, "slots": 7}] * 2, {"scale": 0.1}]
    assert [run.pop("repr") for run in runs] == list(config.repr)
    assert runs[0] == runs[1] == runs[2] == runs[3]
    assert runs[0]["ppo"]["learning_rate"] == 2 * scenario(config, ENV).ppo.learning_rate
    assert runs[0]["seed"] == 1


def test_runs_go_on_from_those_of_another_comparison():
    before = "before/{env}-ppo/runs/{repr}-s{seed}"
    cell, own = Cell(ENV, "ppo", "fp", 3), f"before/{ENV}-ppo/runs/fp-s3"
    assert train_config(small(train={"start_from": before}), cell, 20).start_from == own
    imitated = {"start_from": before, "planner": {"policy": before, "horizon": 5}}
    run = imitate_config(small(learn="imitate", imitate=imitated, train={}), cell, 20)
    assert (run.start_from, run.planner.policy, run.planner.horizon) == (own, own, 5)


def test_tuning_is_shorter_by_default():
    config = small(steps=3000, tuning={})
    cell = tuning_cells(config)[0]
    assert train_config(config, cell, 20).steps == 1000
    assert train_config(config, study_cells(config)[0], 20).steps == 3000


def test_a_scenario_has_steps_of_its_own_for_each_algorithm():
    own = config_for_env("highway-dense")
    for algo, steps in {"ppo": own.steps, "sac": own.continuous.steps}.items():
        config = CompareConfig(env=("highway-dense",), algo=algo, steps=None)
        assert train_config(config, study_cells(config)[0], 20).steps == steps
        assert tune_settings.scenario(TuneConfig(env="highway-dense", algo=algo)).steps == steps


def test_other_traffic_changes_the_scenario_and_nothing_else():
    config = small()
    own = scenario(config, ENV)
    other = scenario(config, ENV, "more")
    assert other.env_config == {**own.env_config, **MORE["more"]}
    assert other.model_copy(update={"env_config": own.env_config}) == own
    run = train_config(config, Cell(ENV, "ppo", "esc", 0, "more"), 20)
    assert run.env_config["vehicles_count"] == 9


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train": {"steps": 5}}, "train: steps: set by the comparison itself"),
        ({"train": {"n_env": 5}}, "train: unknown key 'n_env'; did you mean 'n_envs'"),
        ({"train": {"ppo": {"gamma": 2}}}, "train: ppo.gamma"),
    ],
)
def test_wrong_training_settings(changes, message):
    with pytest.raises(UserError, match=message):
        scenario(small(**changes), ENV)


def test_a_name_with_the_namespace_is_the_same_scenario():
    assert small(env=(f"esc_gym/{ENV}", ENV)).env == (ENV,)


def test_other_traffic_is_other_also_where_the_recipe_changes_it():
    """In training, and for SAC."""
    own = config_for_env("highway-dense").ppo.train_env_config["vehicles_density"]
    sparse = {"highway-dense": {"sparse": {"vehicles_density": 0.6}}}
    config = small(env=("highway-dense",), transfer=sparse, train={})
    assert in_training(scenario(config, "highway-dense")).env_config["vehicles_density"] == own
    there = scenario(config, "highway-dense", "sparse")
    assert {env_config(c)["vehicles_density"] for c in (there, in_training(there))} == {0.6}
    busy = {"intersection-dense": {"busy": {"spawn_probability": 0.9}}}
    config = small(env=("intersection-dense",), transfer=busy, train={}, algo="sac")
    assert env_config(scenario(config, "intersection-dense"))["spawn_probability"] != 0.9
    there = scenario(config, "intersection-dense", "busy")
    assert {env_config(c)["spawn_probability"] for c in (there, in_training(there))} == {0.9}


def test_further_fields_beat_what_the_recipe_changes():
    fields = {"env_config": {"collision_reward": -7}}
    config = small(env=("highway-dense",), transfer={}, train=fields, algo="sac")
    assert env_config(scenario(config, "highway-dense"))["collision_reward"] == -7
    said = {**fields, "ppo": {"train_env_config": {"collision_reward": -3}}}
    run = scenario(small(env=("highway-dense",), transfer={}, train=said), "highway-dense")
    assert env_config(run)["collision_reward"] == -7
    assert in_training(run).env_config["collision_reward"] == -3


def test_a_traffic_that_makes_another_representation_of_one():
    with pytest.raises(UserError, match="other representation of one, got 'exp': esc-exp"):
        check_transfer(small(repr=("esc", "esc-exp"), transfer={ENV: {"exp": {}}}))


@pytest.mark.parametrize(
    "transfer", [{ENV: 5}, {ENV: {}}, {ENV: {"a/b": {}}}, {"merge-dense": MORE}, {ENV: {"x": 5}}]
)
def test_wrong_transfer(transfer):
    with pytest.raises(UserError, match="transfer"):
        check_transfer(small(transfer=transfer))
