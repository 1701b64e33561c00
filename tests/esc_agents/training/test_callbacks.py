"""A clean stop, and what learns when. What checkpoints hold is tested in test_resume."""

import signal

import pytest
import torch

from esc_agents.driving.policies import load_policy
from esc_agents.driving.vectorised import vectorise
from esc_agents.training.callbacks import StopOnSignal
from esc_agents.training.models import new_model
from esc_agents.training.train import train
from tests.esc_agents.tiny import tiny


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_one_signal_asks_and_the_second_ends(number):
    before = signal.getsignal(number)
    with StopOnSignal() as stop:
        assert not stop.interrupted
        signal.raise_signal(number)
        assert stop.interrupted
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(number)
    assert signal.getsignal(number) is before


@pytest.mark.parametrize(("warmup", "moved"), [(0, True), (16, True), (1000, False)])
def test_the_value_network_learns_alone_at_first(warmup, moved, tmp_path):
    """What decides stays as it was until the warm-up is over; what judges does not."""
    settings = {**tiny().ppo.model_dump(), "value_warmup": warmup, "n_steps": 16}
    config = tiny(ppo=settings, steps=64, run_dir=tmp_path / "run")
    untrained = vars(new_model(config, vectorise(config, config.n_envs)))["policy"].state_dict()
    assert train(config)
    trained = load_policy(tmp_path / "run")[0].state_dict()
    same = {name for name in trained if torch.equal(trained[name], untrained[name])}
    judging = {name for name in trained if "value_net" in name}
    assert not judging & same
    assert (same == trained.keys() - judging) != moved
