from math import inf

from esc_agents.driving.episodes import Summary, table
from esc_agents.reporting.tables import markdown, show, terminal


def test_table_shows_numbers_and_intervals(capsys):
    summary = Summary(20, 12.3, 10.0, 14.6, 0.25, 0.11, 0.47, 24.6, 688.8, 0.0, 28.0, 3.0, 7.5, inf)
    show(terminal(table({"esc": summary, "[odd] name": summary}), "highway-v0: 20 episodes"))
    text = capsys.readouterr().out
    assert "highway-v0: 20 episodes" in text
    rows = [line for line in text.splitlines() if "12.30" in line]
    assert len(rows) == 2
    for cell in ("12.30 [10.00, 14.60]", "25% [11%, 47%]", "24.6", "28.0", "3.0", "none"):
        assert cell in rows[0]
    assert "[odd] name" in rows[1]


def test_a_markdown_table():
    rows = [("environment", "ratio"), ("highway-v0", "200x")]
    lines = markdown(rows).splitlines()
    assert lines == ["| environment | ratio |", "| --- | ---: |", "| highway-v0 | 200x |"]
    assert terminal(rows).row_count == 1
