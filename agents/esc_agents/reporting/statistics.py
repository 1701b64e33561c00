"""Statistics of evaluations: pure functions of numbers.

A study's scores are lists, one per scenario (a stratum), of one number per run, that is, seed.
Agarwal et al., "Deep Reinforcement Learning at the Edge of the Statistical Precipice".
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats


def wilson_interval(successes: int, trials: int, level: float = 0.95) -> tuple[float, float]:
    """Wilson score interval of a rate; (0, 1) without trials."""
    if trials == 0:
        return 0.0, 1.0
    interval = stats.binomtest(successes, trials).proportion_ci(level, method="wilson")
    return float(interval.low), float(interval.high)


def mean_interval(values: Sequence[float], level: float = 0.95) -> tuple[float, float, float]:
    """(mean, low, high) with Student's t; low = high = mean where there is no spread to measure."""
    mean = float(np.mean(values))
    if len(values) < 2:
        return mean, mean, mean
    half = stats.t.ppf((1 + level) / 2, len(values) - 1) * stats.sem(values)
    return mean, mean - float(half), mean + float(half)


@dataclass(frozen=True)
class Estimate:
    """A number and its 95 % interval; low = high = value where a stratum has but one run."""

    value: float
    low: float
    high: float


Strata = Sequence[Sequence[float]]


def mean_of_runs(strata: Strata) -> Estimate:
    """Mean over all runs, with a stratified bootstrap interval."""
    return _bootstrap(lambda *samples, axis: _together(samples, axis).mean(axis), strata)


def interquartile_mean(strata: Strata) -> Estimate:
    """Mean of the middle half of all runs, with a stratified bootstrap interval."""
    return _bootstrap(
        lambda *samples, axis: stats.trim_mean(_together(samples, axis), 0.25, axis), strata
    )


def probability_of_improvement(ours: Strata, theirs: Strata) -> Estimate:
    """How often a run of ours beats one of theirs, mean over the strata; half for a tie."""

    def statistic(*samples: NDArray, axis: int) -> Any:
        pairs = zip(samples[: len(ours)], samples[len(ours) :], strict=True)
        return np.mean([_wins(x, y).mean((-2, -1)) for x, y in pairs], axis=0)

    return _bootstrap(statistic, [*ours, *theirs])


def _wins(x: NDArray, y: NDArray) -> NDArray:
    """x [..., m], y [..., n] -> [..., m, n]: 1 where x is larger, 1/2 where they are equal."""
    return (np.sign(x[..., :, None] - y[..., None, :]) + 1) / 2


def difference_of_means(ours: Sequence[float], theirs: Sequence[float]) -> Estimate:
    """ours - theirs, with Welch's t interval, which keeps its level with few runs."""
    value = float(np.mean(ours) - np.mean(theirs))
    spread = max(np.ptp(ours), np.ptp(theirs))
    if min(len(ours), len(theirs)) < 2 or spread <= 1e-9 * np.max(np.abs([*ours, *theirs])):
        return Estimate(value, value, value)
    # By hand: scipy's ttest_ind warns where all runs of one side are alike, which happens.
    a, b = np.var(ours, ddof=1) / len(ours), np.var(theirs, ddof=1) / len(theirs)
    freedom = (a + b) ** 2 / (a**2 / (len(ours) - 1) + b**2 / (len(theirs) - 1))
    half = float(stats.t.ppf(0.975, freedom) * np.sqrt(a + b))
    return Estimate(value, value - half, value + half)


def _together(samples: Sequence[NDArray], axis: int) -> NDArray:
    return np.concatenate(samples, axis=axis)


def _bootstrap(statistic: Callable[..., Any], strata: Strata) -> Estimate:
    """Percentile interval; every stratum is resampled by itself. The same data, the same answer."""
    samples = [np.asarray(sample, float) for sample in strata]
    value = float(statistic(*samples, axis=-1))
    if min(map(len, samples)) < 2:
        return Estimate(value, value, value)
    interval = stats.bootstrap(
        samples, statistic, n_resamples=5000, vectorized=True, axis=-1, method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval  # fmt: skip
    return Estimate(value, *map(float, interval))
