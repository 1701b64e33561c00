"""Films of drives, as GIF: nothing but Pillow is needed to make or to show them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from esc_agents import files
from esc_agents.config import TrainConfig
from esc_agents.driving.environments import make_env
from esc_agents.driving.episodes import Policy

MAX_FPS = 15


class _Camera:
    """Stands in for Gymnasium's RecordVideo, which highway-env calls at every simulated frame."""

    def __init__(self, env: Any) -> None:
        self.env, self.frames, self.frames_per_sec = env, [], 0.0
        env.unwrapped.set_record_video_wrapper(self)
        with _without_screen():
            env.render()  # makes the viewer
        env.unwrapped.viewer.enabled = True  # highway-env paints nothing for the driver "dummy"

    def _capture_frame(self) -> None:
        frame = self.env.unwrapped.viewer
        frame.display()
        self.frames.append(Image.fromarray(np.asarray(frame.get_image())))

    def shoot(self) -> None:
        self.frames.append(Image.fromarray(np.asarray(self.env.render())))


@contextmanager
def _without_screen() -> Iterator[None]:
    """Keeps SDL from looking for a screen, and from complaining where there is none."""
    before = os.environ.get("SDL_VIDEODRIVER")
    os.environ["SDL_VIDEODRIVER"] = "dummy"
    try:
        yield
    finally:
        del os.environ["SDL_VIDEODRIVER"]
        if before is not None:
            os.environ["SDL_VIDEODRIVER"] = before


def film(config: TrainConfig, policy: Policy, seed: int, folder: Path, **options: Any) -> Path:
    """Drive one episode in front of the camera into ``folder``; the GIF plays in real time.

    options: of ``make_env``.
    """
    path = folder / f"seed-{seed}.gif"
    data = gif(*record(config, policy, seed, **options))
    files.write_atomically(path, lambda file: file.write(data))
    return path


def record(
    config: TrainConfig, policy: Policy, seed: int, **options: Any
) -> tuple[list[Image.Image], float]:
    """(frames of one episode, frames a second). options: of ``make_env``."""
    env: Any = make_env(config, render_mode="rgb_array", **options)
    observation, _ = env.reset(seed=seed)
    camera = _Camera(env)
    ended = False
    camera.shoot()
    while not ended:
        batch = {name: value[None] for name, value in observation.items()}
        observation, _, terminated, truncated, _ = env.step(policy(batch)[0])
        camera.shoot()
        ended = terminated or truncated
    rate = env.unwrapped.config["simulation_frequency"]
    env.close()
    every = max(1, round(rate / MAX_FPS))
    return camera.frames[::every] + camera.frames[-1:], rate / every


def gif(frames: Sequence[Image.Image], rate: float) -> bytes:
    """An animation that plays in real time and rests on its end."""
    file = BytesIO()
    frames = [*frames, *[frames[-1]] * 4]
    frames[0].save(
        file, format="GIF", save_all=True, append_images=frames[1:], loop=0,
        duration=round(1000 / rate),
    )  # fmt: skip
    return file.getvalue()
