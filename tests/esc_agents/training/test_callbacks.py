"""A clean stop. What checkpoints hold is tested in test_resume."""

import signal

import pytest

from esc_agents.training.callbacks import StopOnSignal


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
