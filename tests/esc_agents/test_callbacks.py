import signal
from types import SimpleNamespace

import pytest

from esc_agents.callbacks import Checkpoints, StopOnInterrupt


def run_callback(callback, steps, start=0):
    model = SimpleNamespace(
        num_timesteps=start, get_env=lambda: None, logger=None,
        save=lambda file: file.write(str(model.num_timesteps).encode()),
    )  # fmt: skip
    callback.init_callback(model)
    for step in range(start + 1, start + steps + 1):
        model.num_timesteps = step
        callback.on_step()


def test_the_last_two_checkpoints_stay(tmp_path):
    run_callback(Checkpoints(tmp_path, every=10), steps=45)
    assert sorted(f.name for f in tmp_path.iterdir()) == ["000000000030.zip", "000000000040.zip"]
    assert (tmp_path / "000000000040.zip").read_text() == "40"


def test_checkpoints_of_a_resumed_run_keep_the_beat(tmp_path):
    run_callback(Checkpoints(tmp_path, every=10), steps=20, start=25)
    assert sorted(int(f.stem) for f in tmp_path.iterdir()) == [30, 40]


def test_one_interrupt_asks_and_the_second_ends():
    before = signal.getsignal(signal.SIGINT)
    with StopOnInterrupt() as stop:
        assert stop._on_step()
        signal.raise_signal(signal.SIGINT)
        assert stop.interrupted
        assert not stop._on_step()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is before
