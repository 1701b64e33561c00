"""What a process leaves on the disk if it is killed, at every instant at which that changes."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from esc_agents.training.checkpoint import Writer

CHANGES = {name: getattr(os, name) for name in ("mkdir", "rename", "replace", "rmdir", "unlink")}


@contextmanager
def photographed(folder: Path, album: Path) -> Iterator[list[Path]]:
    """Copies of ``folder``: one of each state that it goes through, the last one included.

    Each was made at the last instant of its state, when the next file is there whole, but still
    under its temporary name: a kill leaves that behind.
    """
    photos: list[Path] = []
    states: list[dict[str, bytes | None]] = []

    def shoot() -> None:
        if states[-1:] != [now := contents(folder)]:
            states.append(now)
            photos.append(album / f"{len(photos):03}")
        with pytest.MonkeyPatch.context() as patch:
            for name, change in CHANGES.items():
                patch.setattr(os, name, change)
            restore(folder, photos[-1])

    def shot_before(change):
        def changing(*args, **kwargs):
            shoot()
            return change(*args, **kwargs)

        return changing

    with pytest.MonkeyPatch.context() as patch:
        for name, change in CHANGES.items():
            patch.setattr(os, name, shot_before(change))
        # In a thread of their own, checkpoints would change the folder while it is copied.
        patch.setattr(Writer, "write", Writer._write)
        yield photos
    shoot()


def restore(photo: Path, folder: Path) -> None:
    """Make ``folder`` what it was."""
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(photo, folder)


def contents(folder: Path) -> dict[str, bytes | None]:
    """All files by their place, folders as None; nothing temporary, no locks, TensorBoard, logs."""
    found = {path.relative_to(folder): path for path in sorted(folder.rglob("*"))}
    return {
        str(name): path.read_bytes() if path.is_file() else None
        for name, path in found.items()
        if not any(part[0] == "." or part == "tensorboard" for part in name.parts)
        and name.suffix != ".log"
    }
