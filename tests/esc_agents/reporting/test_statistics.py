from itertools import product
from math import sqrt

import numpy as np
import pytest
from scipy import stats

from esc_agents.reporting.statistics import (
    Estimate,
    difference_of_means,
    interquartile_mean,
    mean_interval,
    mean_of_runs,
    probability_of_improvement,
    wilson_interval,
)


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


def test_interquartile_mean_leaves_a_quarter_out_at_either_end():
    assert interquartile_mean([[0, 1, 2, 3, 100, -50, 4, 5]]).value == (1 + 2 + 3 + 4) / 4
    assert interquartile_mean([[0.0, 100.0], [1.0, 2.0]]).value == 1.5  # over all strata together
    assert interquartile_mean([[3.0]]) == Estimate(3.0, 3.0, 3.0)


def test_bootstrap_interval_of_a_mean_against_every_resample():
    """Of three runs there are 27 resamples: the interval's ends are quantiles of their means."""
    values = [1.0, 2.0, 6.0]
    means = sorted(sum(drawn) / 3 for drawn in product(values, repeat=3))
    estimate = mean_of_runs([values])
    assert estimate.value == 3.0
    assert means[0] <= estimate.low <= means[1] < means[-2] <= estimate.high <= means[-1]


def test_strata_are_resampled_apart():
    """No run of a stratum takes the place of one of another: without spread in each, none."""
    assert mean_of_runs([[1.0, 1.0], [5.0, 5.0]]) == Estimate(3.0, 3.0, 3.0)
    assert mean_of_runs([[1.0, 3.0], [5.0]]) == Estimate(3.0, 3.0, 3.0)  # one run: no spread known
    estimate = mean_of_runs([[1.0, 3.0], [50.0, 50.0]])
    assert (estimate.low, estimate.value, estimate.high) == (25.5, 26.0, 26.5)


def test_the_same_runs_have_the_same_interval():
    values = [list(np.random.default_rng(1).normal(size=5)) for _ in range(3)]
    assert interquartile_mean(values) == interquartile_mean(values)


def test_probability_of_improvement_counts_pairs():
    ours, theirs = [[1.0, 4.0], [2.0, 2.0]], [[2.0, 3.0, 4.0], [2.0, 2.0]]
    # First stratum: 1 beats none of three, 4 beats two and ties with one; the second is a tie.
    assert probability_of_improvement(ours, theirs).value == ((2.5 / 6) + 0.5) / 2
    estimate = probability_of_improvement([[5.0, 6.0, 7.0]], [[1.0, 2.0]])
    assert estimate == Estimate(1.0, 1.0, 1.0)


def test_difference_of_means_is_welchs():
    ours, theirs = [1.0, 2.0, 3.0, 5.0], [0.0, 0.5, 0.25]
    interval = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval()
    estimate = difference_of_means(ours, theirs)
    assert estimate.value == 2.5
    assert (estimate.low, estimate.high) == pytest.approx((interval.low, interval.high))
    assert difference_of_means([1.0], [0.0, 2.0]) == Estimate(0.0, 0.0, 0.0)
    assert difference_of_means([2.0, 2.0], [1.0, 1.0]) == Estimate(1.0, 1.0, 1.0)


@pytest.mark.parametrize("constant", [0.0, 0.38, -7.1])
def test_difference_from_runs_that_are_all_alike_is_students(constant):
    ours = [1.0, 2.0, 3.0, 5.0]
    half = stats.t.ppf(0.975, 3) * stats.sem(ours)
    estimate = difference_of_means(ours, [constant] * 5)
    value = 2.75 - constant
    assert estimate.value == pytest.approx(value)
    assert (estimate.low, estimate.high) == pytest.approx((value - half, value + half))
