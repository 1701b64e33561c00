"""The house: which room may import which, how large a module may grow, how modules are called."""

from __future__ import annotations

import ast
from itertools import pairwise
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
AGENTS = ROOT / "agents" / "esc_agents"
FLOORS = (
    {"ground"}, {"reporting"}, {"driving"}, {"training"},
    {"imitation"}, {"compare", "paper", "proof"}, {"tuning", "zoo"}, {"cli"},
)  # fmt: skip
LINES = 350


def room_of(module: str) -> str:
    """The room of "esc_agents.room.module"; modules beside the rooms are the ground."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 and (AGENTS / parts[1]).is_dir() else "ground"


def floor_of(room: str) -> int:
    (floor,) = (number for number, rooms in enumerate(FLOORS) if room in rooms)
    return floor


def imports(path: Path) -> list[str]:
    """Every module that a file imports, inside functions too."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path}: a relative import hides where it leads"
            found += [f"{node.module}.{alias.name}" for alias in node.names]
    return found


def wrong(path: Path) -> list[str]:
    """Imports of a file of esc_agents that lead up, or across to another room of its floor."""
    own = path.relative_to(AGENTS).parts[0] if path.parent != AGENTS else "ground"
    rooms = {name: room_of(name) for name in imports(path) if name.split(".")[0] == "esc_agents"}
    return [
        name for name, room in rooms.items()
        if room != own and floor_of(room) >= floor_of(own)
    ]  # fmt: skip


def modules(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@pytest.mark.parametrize(
    "path", modules("agents/esc_agents"), ids=lambda path: str(path.relative_to(AGENTS))
)
def test_imports_lead_down(path):
    assert not wrong(path)


def test_an_arrow_that_leads_up_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(f"{__name__}.AGENTS", tmp_path)
    for room in ("driving", "compare", "paper"):
        (tmp_path / room).mkdir()
    path = tmp_path / "driving" / "late.py"
    path.write_text("def f():\n    from esc_agents.compare import grid\n")
    assert wrong(path) == ["esc_agents.compare.grid"]
    path = tmp_path / "paper" / "across.py"
    path.write_text("from esc_agents import files\nimport esc_agents.compare.grid\n")
    assert wrong(path) == ["esc_agents.compare.grid"]


def test_every_room_is_on_a_floor():
    rooms = {path.parent.name for path in AGENTS.glob("*/__init__.py")}
    assert rooms | {"ground"} == set().union(*FLOORS)


def test_the_plugin_knows_nothing_of_the_applications():
    for path in modules("esc_gym"):
        assert not [name for name in imports(path) if name.split(".")[0] == "esc_agents"], path


def test_arrows_in_the_plugin():
    """The kernels know nothing of ours; who knows the engine is SB3's VecEnv and the planner."""
    for path in modules("esc_gym"):
        room = path.relative_to(ROOT / "esc_gym").parts[0]
        ours = {name for name in imports(path) if name.split(".")[0] == "esc_gym"}
        if room == "fastsim":
            assert all(name.startswith("esc_gym.fastsim") for name in ours), path
        if room not in ("vector", "sb3.py", "planning"):
            assert not [name for name in ours if name.startswith("esc_gym.vector")], path


@pytest.mark.parametrize("folder", ["agents", "esc_gym", "tests", "examples"])
def test_no_module_is_too_long(folder):
    sizes = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in modules(folder)}
    assert not {str(path): size for path, size in sizes.items() if size > LINES}


def test_no_two_modules_differ_by_a_suffix():
    """evaluate.py beside evaluation.py: nobody knows which; cli's are called as their commands."""
    rooms = [path for path in modules("agents/esc_agents") if path.parent.name != "cli"]
    names = sorted({path.stem for path in rooms} - {"__init__"})
    for one, other in pairwise(names):
        assert not other.startswith(one.removesuffix("e")), (one, other)


def test_every_command_runs_with_python_m():
    for path in (AGENTS / "cli").glob("[!_]*.py"):
        assert path.read_text().endswith('\n\nif __name__ == "__main__":\n    main()\n'), path
