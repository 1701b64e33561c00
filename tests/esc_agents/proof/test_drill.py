"""The fault drill in short: real processes, really killed. ``make drill`` is the long form."""

import pytest

from esc_agents.cli.drill import command
from esc_agents.errors import UserError

SHORT = ["--kills", "2", "--ppo-steps", "4000", "--sac-steps", "1200", "--only"]


@pytest.mark.slow
@pytest.mark.parametrize("row", ["SIGKILL, PPO", "SIGKILL, SAC", "disk full"])
def test_row(row, capsys):
    assert command([*SHORT, row]) == 0, capsys.readouterr().out
    printed = capsys.readouterr().out
    assert printed.startswith(f"{row}: ")
    assert printed.endswith("Every row ended as it has to.\n")


def test_a_row_that_there_is_not():
    with pytest.raises(UserError, match=r"--only: expected rows among SIGKILL.* got 'SIGTREM'"):
        command(["--only", "SIGTREM"])


def test_a_row_that_fails_is_said(monkeypatch, capsys):
    def row(drill):
        raise drill_module.Failed("not as it has to")

    from esc_agents.proof import drill as drill_module

    monkeypatch.setattr(drill_module, "ROWS", {"SIGTERM": row})
    assert command([]) == 1
    assert "SIGTERM: FAILED: not as it has to" in capsys.readouterr().out
