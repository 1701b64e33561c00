"""What the tests of training, evaluation and the command line share: two finished runs, a shell."""

import shutil
import sys

import pytest

from esc_agents.training.train import train
from tests.esc_agents.tiny import SAC_RUN, tiny


@pytest.fixture(scope="session")
def ppo_run(tmp_path_factory):
    path = tmp_path_factory.mktemp("ppo") / "run"
    assert train(tiny(run_dir=path, checkpoint_every=16))
    return path


@pytest.fixture(scope="session")
def sac_run(tmp_path_factory):
    path = tmp_path_factory.mktemp("sac") / "run"
    assert train(tiny("lane-keeping-v0", algo="sac", run_dir=path, **SAC_RUN))
    return path


@pytest.fixture
def own_run(ppo_run, tmp_path):
    """A copy of the PPO run that a test may change."""
    return shutil.copytree(ppo_run, tmp_path / "own")


@pytest.fixture
def call(tmp_path, monkeypatch, capsys):
    """Run a console script as the shell would, in a folder of its own: (code, out, err)."""
    monkeypatch.chdir(tmp_path)

    def call(script, *args):
        monkeypatch.setattr(sys, "argv", [script.PROGRAM, *map(str, args)])
        with pytest.raises(SystemExit) as end:
            script.main()
        return end.value.code, *capsys.readouterr()

    return call
