"""Where the agents that come with the package lie: run directories, without what training needs."""

from __future__ import annotations

from difflib import get_close_matches
from importlib.resources import files
from pathlib import Path

from esc_agents.errors import UserError

PREFIX = "zoo:"


def folder() -> Path:
    """Inside the wheel, else at the root of the repository."""
    packaged = Path(str(files("esc_agents"))) / "pretrained"
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / "zoo"


def names() -> list[str]:
    """The agents that there are."""
    return sorted(path.parent.name for path in folder().glob("*/policy.json"))


def directory(name: str) -> Path:
    """The run directory of an agent of the zoo. Raises UserError where there is none."""
    if name not in (known := names()):
        near = get_close_matches(name, known, n=1)
        there_are = ", ".join(known) or "none yet"
        hint = f"did you mean {near[0]!r}?" if near else f"there are: {there_are}"
        raise UserError(f"no trained agent {name!r} comes with esc-gym; {hint}")
    return folder() / name


def run_of(source: str) -> Path:
    """The run directory that ``source`` means: a path, or zoo:NAME."""
    if source.startswith(PREFIX):
        return directory(source.removeprefix(PREFIX))
    return Path(source)
