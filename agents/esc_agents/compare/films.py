"""One episode as each representation drives it, in one animation."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PIL import Image, ImageDraw

from esc_agents import files
from esc_agents.compare import store
from esc_agents.compare.analysis import Task
from esc_agents.compare.grid import EPISODES
from esc_agents.config import TrainConfig
from esc_agents.driving.episodes import model_policy
from esc_agents.driving.films import gif, record
from esc_agents.driving.policies import load_policy
from esc_agents.reporting import documents

SECONDS = 12  # of an episode, at most
RATE = 5  # frames a second, at most: a page should not weigh tens of megabytes
WIDEST = 640  # pixels of a tall picture beside others, or a wide one above others
LABEL = 18  # pixels


def film_of(task: Task, out: Path, trust: bool = False) -> documents.Image | None:
    """The animation of a scenario; made once, while the runs' policies are there."""
    path = out / f"drive-{task.folder.name}.gif"
    if not path.exists():
        runs = {repr: task.runs(repr)[0] for repr in task.reprs}
        folders = {repr: store.run_folder(out, result.cell) for repr, result in runs.items()}
        if not all((folder / "policy.json").exists() for folder in folders.values()):
            return None
        films = {}
        for repr, folder in folders.items():
            policy, _ = load_policy(folder, trust=trust)
            config = TrainConfig.model_validate(runs[repr].config)
            films[repr] = record(config, model_policy(policy), EPISODES)
        rate = next(iter(films.values()))[1]
        data = gif(
            together({repr: frames for repr, (frames, _) in films.items()}, rate), shown(rate)
        )
        files.write_atomically(path, lambda file: file.write(data))
    return documents.Image(
        path.name, path.read_bytes(), f"{task.name}, one episode, each driver under its name"
    )


def shown(rate: float) -> float:
    """Frames a second that are kept of so many."""
    return rate / max(1, round(rate / RATE))


def together(films: dict[str, list[Image.Image]], rate: float) -> list[Image.Image]:
    """Films in one picture, each under its name: wide ones above, tall ones beside each other.

    Who is done first waits in grey for the others.
    """
    every = max(1, round(rate / RATE))
    thin = {name: frames[: int(SECONDS * rate)][::every] for name, frames in films.items()}
    length = max(map(len, thin.values()))
    first = next(iter(thin.values()))[0]
    wide = first.width > 2 * first.height
    width = WIDEST if wide else WIDEST // min(len(thin), 3)
    size = width, round(first.height * width / first.width)
    panels = {
        name: [_panel(frames, moment, name, size) for moment in range(length)]
        for name, frames in thin.items()
    }
    across = 1 if wide else min(len(thin), 3)
    return [_grid([panel[moment] for panel in panels.values()], across) for moment in range(length)]


def _panel(
    frames: Sequence[Image.Image], moment: int, name: str, size: tuple[int, int]
) -> Image.Image:
    frame = frames[min(moment, len(frames) - 1)].convert("RGB").resize(size)
    if moment >= len(frames):
        frame = Image.blend(frame, Image.new("RGB", size, "white"), 0.6)
    panel = Image.new("RGB", (size[0], size[1] + LABEL), "white")
    ImageDraw.Draw(panel).text((4, 3), name, fill="black")
    panel.paste(frame, (0, LABEL))
    return panel


def _grid(panels: Sequence[Image.Image], across: int) -> Image.Image:
    width, height = panels[0].size
    down = -(-len(panels) // across)
    grid = Image.new("RGB", (width * across, height * down), "white")
    for index, panel in enumerate(panels):
        grid.paste(panel, (index % across * width, index // across * height))
    return grid
