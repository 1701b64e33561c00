"""A finished run becomes an agent of the zoo."""

from __future__ import annotations

import re
from pathlib import Path
from shutil import copyfile, rmtree

from esc_agents import pretrained
from esc_agents.driving.policies import DESCRIPTION, WEIGHTS
from esc_agents.errors import UserError
from esc_agents.training import run_directory

KEPT = (
    "config.yaml", "command.txt", "versions.json", "wrapper.json", "results.json", WEIGHTS,
    DESCRIPTION,
)  # fmt: skip


def keep(run: Path, name: str) -> Path:
    """Copy what drives out of ``run`` into the zoo, in place of what was called ``name`` there.

    Raises UserError, and changes nothing, for what is no whole run, or no name of a folder.
    """
    if not re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name):
        raise UserError(f"name: expected words as in highway-dense, got {name!r}")
    run_directory.open_run(run)
    if not run_directory.finished(run):
        raise UserError(f"{run} is not finished; continue it with esc-train --resume {run}")
    run_directory.verify(run, *KEPT)
    folder = pretrained.folder() / name
    rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for file in KEPT:
        copyfile(run / file, folder / file)
    run_directory.write_checksums(folder)
    return folder
