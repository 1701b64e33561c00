"""The floors command: one table per scenario, every blind policy in it."""

from __future__ import annotations

from esc_agents.cli import floors
from tests.esc_agents.tiny import tiny


def test_every_blind_policy_stands_in_the_table(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(floors, "load_config", lambda name, trust: tiny())
    out = tmp_path / "docs" / "floors.md"
    assert floors.command(["--scenarios", "small", "--episodes", "2", "--out", str(out)]) == 0
    text = out.read_text()
    assert "## small" in text
    rows = [line.split(" | ") for line in text.splitlines() if line.startswith(("| always", "| r"))]
    actions = ("LANE_LEFT", "IDLE", "LANE_RIGHT", "FASTER", "SLOWER")
    assert [row[0] for row in rows] == [*(f"| always {name}" for name in actions), "| random"]
    lane_changes = {row[0]: float(row[5]) for row in rows}
    assert lane_changes["| always IDLE"] == 0.0
    assert "In 0 of these 2 episodes the ego crashes whatever it does" in text


def test_unknown_scenario(call):
    code, _, err = call(floors, "--scenarios", "nowhere")
    assert code == 2
    assert "no such scenario" in err
