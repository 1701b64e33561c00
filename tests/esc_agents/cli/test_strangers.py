"""A name in any file that a command reads imports nothing, unless the user wrote or trusts it."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

from esc_agents.cli import compare, eval as evaluate, floors, learning, paper, train
from esc_agents.compare import comparison, films
from esc_agents.compare.estimate import Cost
from esc_agents.config import dump
from esc_agents.paper import results
from esc_agents.paper.cells import Cell, Point
from esc_agents.training.run_directory import CHECKSUMS, write_checksums
from tests.esc_agents.compare.small import ENV, HereEngine, small
from tests.esc_agents.tiny import ROAD, SAC_RUN, tiny

NET, CAR = "evilmod:Net", "evilmod.Car"
EVIL = """
from pathlib import Path
from esc_gym.encoders import ESCEncoder
from highway_env.vehicle.behavior import IDMVehicle
Path({mark!r}).touch()
class Net(ESCEncoder): pass
class Car(IDMVehicle): pass
"""
COMPARED = small(repr=("esc",), seeds=1, transfer={})
TASK = f"compared/{ENV}-ppo"
PAPER = Cell(1, 5, "esc", 0)


@pytest.fixture
def mark(tmp_path, monkeypatch):
    """A file that is there once evilmod was imported, in whatever process."""
    path = tmp_path / "lib" / "mark"
    path.parent.mkdir()
    for name in ("evilmod", "othermod"):
        (path.parent / f"{name}.py").write_text(EVIL.format(mark=str(path)))
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.syspath_prepend(path.parent)
    yield path
    sys.modules.pop("evilmod", None)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A finished comparison without its film."""
    out = tmp_path_factory.mktemp("compared") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(films, "gif", lambda *_: b"GIF89a")
        comparison.compare(COMPARED, out, HereEngine())
    (out / f"drive-{ENV}-ppo.gif").unlink()
    return out


@pytest.fixture
def folder(tmp_path, ppo_run, compared, mark, call, monkeypatch):
    """Everything that commands read, in the working directory."""
    shutil.copytree(ppo_run, "run")
    shutil.copytree(compared, "compared")
    Path("train.yaml").write_text(dump(tiny()))
    sac = tiny("lane-keeping-v0", algo="sac", continuous={"env_config": {}}, **SAC_RUN)
    Path("sac.yaml").write_text(dump(sac))
    Path("compare.yaml").write_text(yaml.safe_dump(COMPARED.model_dump(mode="json")))
    Path("paper/cells").mkdir(parents=True)
    results.write(
        Path("paper/cells"), results.Result(PAPER, 1, [Point(1, {5: 1.0})], 1.0, {"device": "cpu"})
    )
    monkeypatch.setattr("esc_agents.compare.engines.LocalEngine", lambda _: HereEngine())
    monkeypatch.setattr(comparison, "costs", lambda configs: [Cost(1.0, 1)] * len(configs))
    monkeypatch.setattr(films, "gif", lambda *_: b"GIF89a")
    return tmp_path


class Case(NamedTuple):
    """A command, a file that it reads, a place in there, and a name to put there.

    imports: whether the command uses that name, once it is trusted. code: what it then ends with.
    gone: files that have to be missing for it.
    """

    program: Any
    args: str
    file: str
    keys: Sequence[str | int]
    name: str
    imports: bool
    code: int = 0
    gone: Sequence[str] = ()


CARS = ("env_config", "other_vehicles_type")
CONTINUOUS = ("continuous", *CARS)
ENCODER, ARGUMENTS = ("encoder", "representation"), ("encoder", "arguments", "representation")
EVAL, TRAIN = "run --episodes 1 --device cpu", "--config train.yaml --run-dir new"
RESUME = "--resume run --steps 48"
DRY = f"--config compare.yaml --env {ENV} --dry-run --out new"
ALL = "--config compare.yaml --out compared"
RESULT = f"{TASK}/results/esc-s0.json"
RUN = f"{TASK}/runs/esc-s0"
TUNED = f"{TASK}/tuning/esc-lr1-x0.1-s1000.json"
CELL = "paper/cells/b1-5-esc-s0.json"
PAPER_RUN = "run --benchmarks 1 --cases 5 --repr esc --seeds 1 --updates 1 --out paper"
CASES = {
    "eval, policy": Case(evaluate, EVAL, "run/policy.json", ENCODER, NET, True),
    "eval, best policy": Case(
        evaluate, EVAL, "run/best_policy.json", ENCODER, NET, True, gone=["run/policy.json"]
    ),
    "eval, cars": Case(evaluate, EVAL, "run/config.yaml", CARS, CAR, True),
    "eval, repr": Case(evaluate, EVAL, "run/config.yaml", ("repr",), NET, False),
    "eval, env": Case(evaluate, EVAL, "run/config.yaml", ("env",), "evilmod:x-v0", False, -1),
    "eval, continuous": Case(evaluate, EVAL, "run/config.yaml", CONTINUOUS, CAR, False),
    "eval, arguments": Case(evaluate, EVAL, "run/config.yaml", ARGUMENTS, NET, False, 2),
    "resume, repr": Case(train, RESUME, "run/config.yaml", ("repr",), NET, True),
    "resume, cars": Case(train, RESUME, "run/config.yaml", CARS, CAR, True),
    "train, repr": Case(train, TRAIN, "train.yaml", ("repr",), NET, True),
    "train, arguments": Case(train, TRAIN, "train.yaml", ARGUMENTS, NET, False, 2),
    "train, cars": Case(train, TRAIN, "train.yaml", CARS, CAR, True),
    "train, continuous": Case(
        train, "--config sac.yaml --run-dir new --steps 16", "sac.yaml", CONTINUOUS, CAR, True
    ),
    "floors": Case(
        floors, "--scenarios train.yaml --episodes 1 --out floors.md", "train.yaml", CARS, CAR, True
    ),
    "learning": Case(learning, "--runs run --out l.md", "run/config.yaml", CARS, CAR, False),
    "compare, repr": Case(compare, DRY, "compare.yaml", ("repr", 0), NET, True),
    "compare, cars": Case(compare, DRY, "compare.yaml", ("train", *CARS), CAR, True),
    "compare, arguments": Case(compare, DRY, "compare.yaml", ("train", *ARGUMENTS), NET, False, 2),
    "compare, transfer": Case(
        compare, DRY, "compare.yaml", ("transfer", ENV, "x", CARS[1]), CAR, True
    ),
    "compare, task": Case(compare, ALL, f"{TASK}/task.yaml", ("train", *CARS), CAR, False, 2),
    "compare, baselines": Case(
        compare, ALL, f"{TASK}/baselines.json", ("made_with", "repr"), NET, False
    ),
    "compare, result": Case(compare, ALL, RESULT, ("config", *CARS), CAR, True),
    "compare, tuning": Case(compare, ALL, TUNED, ("made_with", "repr"), NET, False),
    "compare, film": Case(compare, ALL, f"{RUN}/policy.json", ENCODER, NET, True),
    "compare, unmeasured run": Case(
        compare, ALL, f"{RUN}/policy.json", ENCODER, NET, True, gone=[RESULT]
    ),
    "compare, unfinished run": Case(
        compare, ALL, f"{RUN}/config.yaml", CARS, CAR, False, 2,
        gone=[RESULT, f"{RUN}/{CHECKSUMS}", f"{RUN}/results.json"],
    ),
    "paper report": Case(paper, "report --out paper", CELL, ("cell", "repr"), NET, False),
    "paper run": Case(paper, PAPER_RUN, CELL, ("made_with", "repr"), NET, False),
}  # fmt: skip


def plant(path: Path, keys: Sequence[str | int], name: str) -> None:
    """Put ``name`` into a file; whoever can do that can also count a checksum."""
    values = (json.loads if path.suffix == ".json" else yaml.safe_load)(path.read_text())
    *parents, last = keys
    inner = values
    for key in parents:
        inner[key] = inner.get(key) or {}
        inner = inner[key]
    inner[last] = name
    if "schema" in values and "sha256" in values:
        content = {k: v for k, v in values.items() if k not in ("sha256", "mac")}
        text = json.dumps(content, sort_keys=True)
        values["sha256"] = hashlib.sha256(text.encode()).hexdigest()
    path.write_text(json.dumps(values) if path.suffix == ".json" else yaml.safe_dump(values))


@pytest.mark.parametrize("name", CASES)
def test_planted_names(name, folder, mark, call):
    case = CASES[name]
    for gone in case.gone:
        Path(gone).unlink()
    plant(Path(case.file), case.keys, case.name)
    if (sums := Path(case.file).with_name(CHECKSUMS)).exists():
        write_checksums(sums.parent)
    code, _, err = call(case.program, *case.args.split())
    assert (code, err.count("\n")) == (2, 1)
    assert f"{case.file} names {case.name!r}" in err
    assert "add --trust" in err
    assert not mark.exists()
    if case.code >= 0:
        code, _, err = call(case.program, *case.args.split(), "--trust")
        assert code == case.code
        assert " names " not in err
        assert mark.exists() == case.imports


@pytest.mark.parametrize(
    "name", ["evilmod", "esc_gym.evil:X", "esc_gym.theory:math", "highway_env.utils.importlib"]
)
@pytest.mark.parametrize("keys", [("repr",), CARS])
def test_names_that_are_nothing_of_ours(name, keys, folder, mark, call):
    """An ordinary error, to which --trust is no answer."""
    plant(Path("train.yaml"), keys, name)
    code, _, err = call(train, *TRAIN.split())
    assert (code, err.count("\n")) == (2, 1)
    assert "--trust" not in err
    assert not mark.exists()


def test_own_names_need_no_trust(mark, call, monkeypatch):
    """Typed, they are the user's; and so is the run, until somebody changes it or takes it."""
    Path("train.yaml").write_text(dump(tiny(checkpoint_every=16)))
    cars = f"{{{CARS[1]}: {CAR}}}"
    typed = ["--config", "train.yaml", "--repr", NET, "--env-config", cars, "--run-dir", "run"]
    commands = [
        (train, *typed),
        (evaluate, *EVAL.split()),
        (train, *RESUME.split()),
        (train, "--config", "run/config.yaml", "--run-dir", "twin"),
        (learning, "--runs", "run", "--out", "l.md"),
    ]
    for program, *args in commands:
        code, _, err = call(program, *args)
        assert (code, err) == (0, "")
    assert mark.exists()
    mark.unlink()

    shutil.copytree("run", "changed")
    Path("changed", CHECKSUMS).unlink()
    plant(Path("changed/policy.json"), ("encoder", "representation"), "othermod:Net")
    code, _, err = call(evaluate, "changed", "--episodes", 1)
    assert code == 2
    assert "changed/policy.json names 'othermod:Net'" in err

    monkeypatch.setenv("XDG_STATE_HOME", "another home")
    for program, *args in commands[1:]:
        monkeypatch.delitem(sys.modules, "evilmod", raising=False)
        code, _, err = call(program, *args)
        assert code == 2
        assert "run/config.yaml names 'evilmod" in err
    assert not mark.exists()


def test_own_comparison_needs_no_trust(mark, call, monkeypatch):
    """Also where only its report is written anew, from results and policies."""
    monkeypatch.setattr(films, "gif", lambda *_: b"GIF89a")
    cars = {**ROAD, CARS[1]: CAR}
    config = small(
        repr=(NET,), seeds=1, transfer={}, tuning={"seeds": 0},
        train={**COMPARED.train, "env_config": cars},
    )  # fmt: skip
    for _ in range(2):
        comparison.compare(config, Path("own"), HereEngine())
        assert mark.exists()
        Path(f"own/drive-{ENV}-ppo.gif").unlink()
