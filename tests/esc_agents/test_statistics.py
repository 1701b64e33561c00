from math import sqrt

import pytest
from scipy import stats

from esc_agents.statistics import mean_interval, wilson_interval


@pytest.mark.parametrize(("successes", "trials"), [(0, 1), (1, 1), (3, 10), (50, 100), (0, 20)])
def test_wilson_ends_are_where_the_score_test_just_accepts(successes, trials):
    # The definition: all p with |p_hat - p| <= z * sqrt(p (1 - p) / n), solved for p.
    z, rate = 1.959963984540054, successes / trials
    center = (rate + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z / (1 + z**2 / trials) * sqrt(rate * (1 - rate) / trials + z**2 / (4 * trials**2))
    low, high = wilson_interval(successes, trials)
    assert (low, high) == pytest.approx((center - half, center + half), abs=1e-9)
    for p in (low, high):
        assert abs(rate - p) == pytest.approx(z * sqrt(p * (1 - p) / trials), abs=1e-6)


def test_wilson_known_value_and_no_trials():
    # 8 of 10, a textbook example: 49.0 % to 94.3 %.
    assert wilson_interval(8, 10) == pytest.approx((0.490, 0.943), abs=5e-4)
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_mean_interval_is_students():
    values = [1.0, 2.0, 3.0, 4.0]
    half = 3.182446 * 1.2909944 / 2  # t(0.975, 3 degrees of freedom) * s / sqrt(4)
    assert mean_interval(values) == pytest.approx((2.5, 2.5 - half, 2.5 + half), rel=1e-6)
    test = stats.ttest_1samp(values, 0.0).confidence_interval(0.8)
    assert mean_interval(values, 0.8)[1:] == pytest.approx((test.low, test.high))


def test_mean_interval_without_spread():
    assert mean_interval([7.0]) == (7.0, 7.0, 7.0)
    assert mean_interval([2.0, 2.0, 2.0]) == (2.0, 2.0, 2.0)
