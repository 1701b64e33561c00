"""The speed command: its tables, its comparison, its files, and what a user can get wrong."""

from __future__ import annotations

import sys
from copy import deepcopy

import gymnasium as gym
import numpy as np
import pytest
from highway_env.vehicle.behavior import IDMVehicle

from esc_agents.cli import bench as cli
from esc_agents.errors import UserError
from esc_agents.proof import bench, end_to_end, planning, scaling, timing
from esc_agents.proof.bench import (
    GENERATOR,
    MARKERS,
    Side,
    Speed,
    difference,
    draw_actions,
    race,
    state,
)
from esc_gym.fastsim.behavior import original_behavior
from esc_gym.registration import HIGHWAY_ENV_IDS
from tests.esc_agents.tiny import tiny

QUICK = ["--envs", "highway-fast-v0", "--seconds", "0.01", "--seeds", "1"]
SPEED = Speed("highway-v0", (0.25, 0.012), (0.00125, 0.002), 1.0, 3, {})


@pytest.fixture
def road():
    """Lane keeping: a step costs almost nothing."""
    env = gym.make("lane-keeping-v0")
    yield env
    env.close()


@pytest.mark.slow
def test_from_start_to_end(tmp_path, capsys):
    out, readme = tmp_path / "docs" / "speed.md", tmp_path / "README.md"
    readme.write_text(f"# Before\n{MARKERS[0]}\nold\n{MARKERS[1]}\nafter\n")
    arguments = [*QUICK, "--out", str(out), "--readme", str(readme)]
    assert cli.command(arguments) == 0
    assert "[1/1] highway-fast-v0: " in capsys.readouterr().out
    text = out.read_text()
    assert f"Written by `esc-bench {' '.join(arguments)}`: 20" in text
    assert "highway-env 1." in text
    row = next(line.split(" | ") for line in text.splitlines() if "| highway-fast-v0" in line)
    assert row[-1] == "1 seed, all equal |"
    assert 0 < float(row[2]) < float(row[1])
    short = readme.read_text()
    assert short.startswith(f"# Before\n{MARKERS[0]}\n| environment |")
    assert short.endswith(f"{MARKERS[1]}\nafter\n")
    assert "old" not in short
    assert " | ".join(row[:4]) in short


def test_intersections_leave_no_trace():
    with original_behavior(IDMVehicle):
        before = IDMVehicle.DISTANCE_WANTED
        speed = bench.measure("intersection-v0", 1, 0.01)
        assert before == IDMVehicle.DISTANCE_WANTED
    assert speed.differences == {}
    assert speed.stock > speed.ours


def test_training_of_both_sides(monkeypatch):
    monkeypatch.setattr(end_to_end, "ROUNDS", 1)
    said = []
    row = end_to_end.measure(tiny(), 0.01, said.append)
    assert len(row) == len(end_to_end.COLUMNS)
    assert row[0] == "highway-fast-v0"
    assert all(cell.endswith("x") for cell in row[4:6])
    costs = [float(cell.replace(",", "")) for cell in (*row[1:4], *row[6:])]
    assert min(costs) > 0
    assert sum(costs[3:]) == pytest.approx(1e6 / costs[2], rel=0.02)
    assert said[0].startswith("PPO on highway-fast-v0: ")


def test_a_decision_of_both_sides():
    row = planning.measure("highway-fast-v0", 0.01)
    assert len(row) == len(planning.COLUMNS)
    assert (row[0], row[-1]) == ("highway-fast-v0", "equal")
    copied, alone, together, beside, observed, twice = (
        float(cell.replace(",", "").removesuffix("x")) for cell in row[1:-1]
    )
    assert min(copied, alone, together, observed, twice) > 0
    assert beside == pytest.approx(copied / together, rel=0.1)


def test_a_planner_that_errs_is_told(monkeypatch):
    monkeypatch.setattr(planning, "by_deep_copies", lambda env, plans: np.ones(len(plans)))
    assert planning.measure("highway-fast-v0", 0.01)[-1] == "DIFFER"


def test_row():
    assert SPEED.cells() == [
        "highway-v0", "250", "1.25", "200x", "12", "2", "100%", "3 seeds, all equal",
    ]  # fmt: skip
    speed = Speed("intersection-multi-agent-v0", (2, 1), (1, 1), 0.5, 1, {0: "speed, step 4"})
    name, *_, compiled, same = speed.cells()
    assert (name, compiled) == ("intersection-multi-agent-v0 *", "50%")
    assert same == "seed 0 differs: speed, step 4"


@pytest.mark.parametrize(
    ("number", "text"), [(1234.5, "1,234"), (99.94, "99.9"), (1.0, "1"), (0.08123, "0.0812")]
)
def test_significant(number, text):
    assert timing.significant(number) == text


def test_ratio():
    assert timing.ratio(10.0, 0.05) == "200x"
    assert timing.ratio(1.84, 1.0) == "1.8x"


@pytest.mark.parametrize("name", ["position", "heading", "speed"])
def test_the_last_bit_makes_a_difference(road, name):
    road.reset(seed=0)
    before = state(road, 1.0)
    assert difference({0: before}, {0: state(road, np.float64(1))}) is None
    value = getattr(road.unwrapped.road.vehicles[0], name)
    setattr(road.unwrapped.road.vehicles[0], name, np.nextafter(value, np.inf))
    assert difference({7: before}, {7: state(road, 1.0)}) == f"{name} of vehicle 0, step 7"


def test_an_episode_that_ends_sooner_is_a_difference(road):
    road.reset(seed=0)
    assert difference({5: state(road)}, {6: state(road)}).endswith("step 5")


def test_watched_or_not_a_drive_ends_the_same(road):
    actions = draw_actions(road.action_space, 0)
    watched, timed = (Side(road).drive(0, actions, watch) for watch in (True, False))
    assert list(watched) == list(range(len(watched)))
    assert len(watched) > 2
    assert list(timed) == list(watched)[-1:]
    last = len(watched) - 1
    assert difference({last: watched[last]}, timed, GENERATOR) is None


def test_all_that_is_compared(road):
    road.reset(seed=0)
    vehicle = road.unwrapped.road.vehicles[0]
    before = state(road)
    assert "reward" in difference({0: before}, {0: state(road, np.nextafter(0.0, 1.0))})
    assert "terminated" in difference({0: before}, {0: state(road, 0, True)})
    assert "truncated" in difference({0: before}, {0: state(road, 0, False, True)})
    vehicle.crashed = True
    assert "crashed of vehicle 0" in difference({0: before}, {0: state(road)})
    vehicle.crashed, vehicle.lane_index = False, ("c", "elsewhere", 0)
    assert "lane_index of vehicle 0" in difference({0: before}, {0: state(road)})
    road.reset(seed=0)
    road.unwrapped.road.vehicles.append(deepcopy(vehicle))
    assert "of vehicle 1" in difference({0: before}, {0: state(road)})
    road.reset(seed=0)
    road.unwrapped.np_random.random()
    assert difference({0: before}, {0: state(road)}) == f"{GENERATOR}, step 0"
    assert difference({0: before}, {0: state(road)}, GENERATOR) is None


class Drift(gym.Wrapper):
    """Not quite the same environment."""

    def step(self, action):
        result = super().step(action)
        self.unwrapped.vehicle.position[0] += 1e-9
        return result


def test_race(road):
    with Drift(gym.make("lane-keeping-v0")) as drifting:
        best, differences = race(Side(road), Side(drifting), range(2), 0.0)
    assert best.shape == (2, 2)
    assert (best > 0).all()
    assert set(differences) == {0, 1}
    assert differences[0].endswith("step 1")
    with gym.make("lane-keeping-v0") as twin:
        assert race(Side(road), Side(twin), range(2), 0.0)[1] == {}


def test_actions_repeat_and_vary():
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    assert np.array_equal(draw_actions(space, 2), draw_actions(space, 2))
    assert not np.array_equal(draw_actions(space, 2), draw_actions(space, 4))
    assert np.abs(draw_actions(space, 3)).max() <= 0.05


def test_a_difference_ends_with_code_1(monkeypatch):
    differing = Speed("highway-v0", (1, 1), (1, 1), 1.0, 1, {0: "reward, step 3"})
    monkeypatch.setattr(bench, "in_own_process", lambda *_: differing)
    assert cli.command(QUICK) == 1


def test_all_environments_by_default(monkeypatch):
    measured = []
    monkeypatch.setattr(bench, "in_own_process", lambda _, id, *rest: measured.append(id) or SPEED)
    assert cli.command([]) == 0
    assert tuple(measured) == HIGHWAY_ENV_IDS
    assert len(measured) == 31


def test_readme_needs_the_markers_in_order(tmp_path):
    path = tmp_path / "README.md"
    for text in ("nothing", MARKERS[0], MARKERS[1] + MARKERS[0]):
        path.write_text(text)
        with pytest.raises(UserError, match="expected <!-- esc-bench --> and, below it"):
            bench.replace_block(path, "table")
    path.write_text(f"a{MARKERS[0]}old{MARKERS[1]}b")
    assert bench.replace_block(path, "table") == f"a{MARKERS[0]}\ntable\n{MARKERS[1]}b"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--envs", "highway-v9"], "got 'highway-v9'; try 'highway-v0'"),
        (["--envs", "highway-v0", "--readme", "nowhere.md"], "nowhere.md: No such file"),
        (["--envs", "exit-v0", "--planning"], "--planning: expected highway-v0 or highway-fast"),
        (["--envs", "merge-v0", "--end-to-end"], "expected highway-v0 or highway-fast-v0"),
        (["--envs"], "at least one"),
        (["--envs", "highway-v0", "--out", "."], "a file that can be written, got ."),
        (["--envs", "highway-v0", "--out", "file/speed.md"], "file/speed.md: File exists"),
        (["--seconds", "0"], "greater than 0"),
        (["--seeds", "none"], "seeds"),
        (["--env", "highway-v0"], "--envs"),
    ],
)
def test_user_errors(arguments, message, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    monkeypatch.setattr(sys, "argv", ["esc-bench", *arguments])
    with pytest.raises(SystemExit) as end:
        cli.main()
    assert end.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("esc-bench: ")
    assert message in error
    assert error.count("\n") == 1


def test_of_several_visits_the_fastest_of_each_side_counts(monkeypatch):
    """An id's process may be slowed down in one of them, by whatever else the machine does."""
    visits = iter([(4.0, 1.0, 0.25), (8.0, 2.0, 0.5), (2.0, 3.0, 0.125), (16.0, 1.0, 0.5)])
    monkeypatch.setattr(
        scaling, "in_own_process", lambda _, id, seconds: scaling.BatchSpeed(id, *next(visits))
    )
    said = []
    _, one, two = scaling.rows(["one", "two"], 1.0, said.append)
    assert one == ["one", "0.5", "1", "8", "8.0x", "16x"]
    assert two == ["two", "0.125", "1", "2", "2.0x", "16x"]
    assert [line.split(":")[0] for line in said] == [
        "[1/4] one", "[2/4] two", "[3/4] one", "[4/4] two",
    ]  # fmt: skip
