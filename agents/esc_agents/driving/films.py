"""Films of drives, as GIF: nothing but Pillow is needed to make or to show them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
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
LONGEST = 60  # seconds: a lap of the racetrack, of which an episode has five minutes


class _Camera:
    """Stands in for Gymnasium's RecordVideo, which highway-env calls at every simulated frame.

    every: of how many frames one is kept.
    """

    def __init__(self, env: Any, every: int) -> None:
        self.env, self.every, self.frames, self.frames_per_sec = env, every, [], 0.0
        self._shown = 0
        env.unwrapped.set_record_video_wrapper(self)
        with _without_screen():
            env.render()  # makes the viewer
        env.unwrapped.viewer.enabled = True  # highway-env paints nothing for the driver "dummy"

    def _capture_frame(self) -> None:
        frame = self.env.unwrapped.viewer
        frame.display()
        self._keep(frame.get_image)

    def shoot(self, always: bool = False) -> None:
        """A frame between two policy steps. always: keep it in any case."""
        self._keep(self.env.render, always)

    def _keep(self, look: Callable[[], Any], always: bool = False) -> None:
        if always or self._shown % self.every == 0:
            self.frames.append(Image.fromarray(np.asarray(look())))
        self._shown += 1


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
    """(frames of one episode, of its first minute if it is longer; frames a second).

    options: of ``make_env``.
    """
    env: Any = make_env(config, render_mode="rgb_array", **options)
    observation, _ = env.reset(seed=seed)
    rate = env.unwrapped.config["simulation_frequency"]
    every = max(1, round(rate / MAX_FPS))
    camera = _Camera(env, every)
    ended = False
    camera.shoot()
    while not ended and len(camera.frames) * every < LONGEST * rate:
        batch = {name: value[None] for name, value in observation.items()}
        observation, _, terminated, truncated, _ = env.step(policy(batch)[0])
        camera.shoot()
        ended = terminated or truncated
    camera.shoot(always=True)
    env.close()
    return camera.frames, rate / every


def gif(frames: Sequence[Image.Image], rate: float) -> bytes:
    """An animation that plays in real time and rests on its end."""
    file = BytesIO()
    frames = [*frames, *[frames[-1]] * 4]
    frames[0].save(
        file, format="GIF", save_all=True, append_images=frames[1:], loop=0,
        duration=round(1000 / rate),
    )  # fmt: skip
    return file.getvalue()
