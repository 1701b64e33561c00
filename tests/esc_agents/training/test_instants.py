"""A run killed at any instant at which its files change, above all at its end, is finished by
resuming it: with the files of a run that never stopped, byte for byte."""

from __future__ import annotations

import hashlib
import re
import shutil
import signal
import zipfile
from io import BytesIO

import pytest

from esc_agents.errors import UserError
from esc_agents.training import callbacks, run_directory
from esc_agents.training.checkpoint import in_order
from esc_agents.training.models import load_model
from esc_agents.training.train import train
from tests.esc_agents.instants import contents, photographed, restore
from tests.esc_agents.tiny import SAC_RUN, tiny

STEPS_OR_NONE = (
    r"^\d+$|holds no policy yet|add --trust|"
    r"killed between the two, and esc-train or esc-imitate --resume"
)


def steps_of(run):
    """Of the newest checkpoint."""
    return max((int(path.stem) for path in in_order(run / "checkpoints")), default=0)


def files_of(run):
    """What has to be the same: zips and checkpoints hold the time, comments where the run lies."""
    found = contents(run)
    sums = [
        f"{hashlib.sha256(content).hexdigest()}  {name}\n"
        for name, content in found.items()
        if content is not None and "/" not in name and name != "SHA256SUMS"
    ]
    assert found.pop("SHA256SUMS").decode() == "".join(sums)
    del found["command.txt"]
    found["config.yaml"] = re.sub(rb"^#.*\n", b"", found["config.yaml"], flags=re.M)
    for name, content in found.items():
        if name.endswith(".zip"):
            with zipfile.ZipFile(BytesIO(content)) as file:
                found[name] = {part: file.read(part) for part in file.namelist() if part != "data"}
        elif name.endswith(".checkpoint"):
            found[name] = None
    return found


def policy_of(config, run):
    """Training steps of what esc-eval would drive, or why it does not."""
    try:
        return load_model(config, run)[1]
    except UserError as error:
        return str(error)


def check_finishes(run, expected, **asked):
    """Resumed, also with what is ``asked``, it ends with these files; until then nothing is said
    that is not so."""
    config = run_directory.open_run(run)
    finished = run_directory.finished(run)
    policy = policy_of(config, run)
    assert policy == config.steps if finished else re.search(STEPS_OR_NONE, str(policy))
    if finished and not asked:
        with pytest.raises(UserError, match="steps already; ask for more with --steps"):
            train(config, resume=run)
    else:
        assert train(config.model_copy(update=asked), resume=run)
    check_same(run, expected)


def check_same(run, expected):
    found = files_of(run)
    assert found.keys() == expected.keys()
    assert [name for name in found if found[name] != expected[name]] == []


@pytest.mark.parametrize(
    ("config", "begin"),
    [
        (tiny(checkpoint_every=16), 0),
        (tiny("lane-keeping-v0", algo="sac", **SAC_RUN), SAC_RUN["steps"]),
    ],
    ids=["PPO, from its first file", "SAC, from its last checkpoint"],
)
def test_a_run(config, begin, tmp_path):
    here = tmp_path / "here"
    here.mkdir()
    run = here / "run"
    config = config.model_copy(update={"run_dir": run})
    with photographed(here, tmp_path / "album") as photos:
        assert train(config)
    expected = files_of(run)
    chosen = [photo for photo in photos if steps_of(photo / "run") >= begin]
    # In the last one it is finished; in the one before it lacks nothing but that word.
    assert [run_directory.finished(photo / "run") for photo in chosen[-2:]] == [False, True]
    assert (chosen[-2] / "run" / "results.json").exists()
    for photo in chosen:
        restore(photo, here)
        if run.exists():
            check_finishes(run, expected)
        else:
            assert train(config)
            check_same(run, expected)


def test_a_finished_run_that_is_to_make_more_steps(own_run, tmp_path):
    before, config = files_of(own_run), run_directory.open_run(own_run)
    with photographed(own_run, tmp_path / "album") as photos:
        assert train(config.model_copy(update={"steps": 64}), resume=own_run)
    expected, noted = files_of(own_run), set()
    for photo in photos:
        restore(photo, own_run)
        noted.add(steps := run_directory.open_run(own_run).steps)
        check_finishes(own_run, expected if steps == 64 else before)
        if steps != 64:
            restore(photo, own_run)
            check_finishes(own_run, expected, steps=64)
    assert noted == {32, 64}


def test_a_run_that_was_asked_to_stop(tmp_path, monkeypatch):
    def interrupt(self):
        if self.num_timesteps == 20:
            signal.raise_signal(signal.SIGTERM)
        return log(self)

    run, log = tmp_path / "run", callbacks.DrivingLog._on_step
    evaluation = {"episodes": 1, "every": 64}
    config = tiny(run_dir=run, steps=64, checkpoint_every=16, evaluation=evaluation)
    assert train(config)
    expected = files_of(run)
    shutil.rmtree(run)
    monkeypatch.setattr(callbacks.DrivingLog, "_on_step", interrupt)
    with photographed(tmp_path, tmp_path.with_name("album")) as photos:
        assert not train(config)
    monkeypatch.undo()
    stopped = [photo for photo in photos if steps_of(photo / "run") == 32]
    assert len(stopped) == 4  # nothing after the checkpoint, then the three files of the policy
    for photo in stopped:
        restore(photo, tmp_path)
        check_finishes(run, expected)


def test_a_finished_run_without_checkpoints(own_run):
    shutil.rmtree(own_run / "checkpoints")
    before = contents(own_run)
    config = run_directory.open_run(own_run).model_copy(update={"steps": 64})
    with pytest.raises(UserError, match="is finished, and without checkpoints it cannot go on"):
        train(config, resume=own_run)
    assert contents(own_run) == before
