"""What is said of a policy beside those that never look."""

from __future__ import annotations

import pytest

from esc_agents.driving.baselines import verdict
from esc_agents.driving.episodes import Summary
from tests.esc_agents.compare.small import episode


def summary(*returns: float) -> Summary:
    return Summary.of([episode(value) for value in returns])


BLIND = {"random": summary(1.0, 9.0), "always SLOWER": summary(6.9, 7.0, 7.1)}


@pytest.mark.parametrize(
    ("returns", "expected"),
    [
        # Student's t, by hand: 5 +- 12.71 * 4; 7 +- 4.303 * 0.1 / sqrt(3).
        ((59.9, 60.1), "esc is above every policy that never looks: 60.00 [58.73, 61.27] beside "
         "5.00 [-45.82, 55.82] of random."),
        ((54.0, 56.0), "esc is not clearly above every policy that never looks: "
         "55.00 [42.29, 67.71] beside 5.00 [-45.82, 55.82] of random."),
    ],
)  # fmt: skip
def test_the_interval_that_reaches_highest_counts(returns, expected):
    assert verdict("esc", summary(*returns), BLIND) == expected


def test_a_narrow_rival_may_be_the_best():
    blind = {name: BLIND[name] for name in ("always SLOWER",)} | {"random": summary(1.0, 1.0)}
    assert verdict("esc", summary(8.0, 8.0), blind).endswith("7.00 [6.75, 7.25] of always SLOWER.")


def test_beside_the_best_of_those_that_a_policy_may_not_be_above():
    blind = {
        "wide": summary(-80.0, 100.0), "better": summary(*[19.0, 20.0, 21.0] * 5),
        "less": summary(*[1.0, 2.0, 3.0] * 5),
    }  # fmt: skip
    assert verdict("esc", summary(*[15.0, 16.0, 17.0] * 5), blind).endswith(" of better.")
    assert verdict("esc", summary(*[24.0, 25.0, 26.0] * 5), blind).endswith(" of wide.")
