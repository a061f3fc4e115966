"""Statistics over episodes: robust summaries (Agarwal et al. 2021) and the bound on a rare event's probability."""

from collections.abc import Iterable
from typing import TypedDict

import numpy as np
from scipy import stats

RESAMPLES = 10_000
STRATIFIED_RESAMPLES = 50_000
AT_ONCE = 2**21  # scores of resamples that are in memory at once
CONFIDENCE = 0.95  # of the bound


class Summary(TypedDict):
    """Holds statistics of values: `iqm`, mean, 95 % interval of the IQM, 5th and 95th percentile, and the largest."""

    iqm: float
    mean: float
    ci95: list[float]
    p5: float
    p95: float
    max: float


def iqm(values: np.ndarray, axis: int | None = -1) -> np.ndarray:
    """Returns the interquartile mean, the mean of the middle half, by scipy's trimmed mean."""
    return stats.trim_mean(values, 0.25, axis=axis)


def summarised(values: np.ndarray, interval: Iterable[float]) -> Summary:
    """Returns the `Summary` of all values, of any shape, with the given interval."""
    p5, p95 = np.percentile(values, [5.0, 95.0])
    return {
        "iqm": float(iqm(values, axis=None)),
        "mean": float(values.mean()),
        "ci95": [float(bound) for bound in interval],
        "p5": float(p5),
        "p95": float(p95),
        "max": float(values.max()),
    }


def summary(values: np.ndarray, seed: int = 0) -> Summary:
    """Returns the `Summary` of values (episodes,), with the interval of the percentile bootstrap."""
    if np.ptp(values) == 0.0:  # scipy's bootstrap has no interval for a constant
        return summarised(values, [values[0]] * 2)
    result = stats.bootstrap(
        (values,),
        iqm,
        n_resamples=RESAMPLES,
        method="percentile",
        rng=np.random.default_rng(seed),
        batch=1000,
    )
    return summarised(values, result.confidence_interval)


def stratified_bootstrap(
    scores: np.ndarray, rng: np.random.Generator, resamples: int = STRATIFIED_RESAMPLES
) -> np.ndarray:
    """Returns IQMs (resamples,) of stratified bootstrap resamples of scores (runs, tasks).

    The resampling follows Agarwal et al. (2021, Sec. 4): each task is a stratum, and its runs are drawn with
    replacement, independently of the other tasks.
    """
    size = max(1, AT_ONCE // scores.size)
    iqms = []
    for start in range(0, resamples, size):
        drawn = rng.integers(len(scores), size=(min(size, resamples - start), *scores.shape))
        resampled = np.take_along_axis(scores[None], drawn, axis=1)
        iqms.append(iqm(resampled.reshape(len(drawn), -1)))
    return np.concatenate(iqms)


def summary_of_runs(scores: np.ndarray, seed: int = 0) -> Summary:
    """Returns the `Summary` of scores (runs, tasks), with the interval of the stratified bootstrap.

    The interval of a single run is that of `summary` over its tasks.
    """
    if len(scores) == 1:
        return summary(scores[0], seed)
    resampled = stratified_bootstrap(scores, np.random.default_rng(seed))
    return summarised(scores, np.percentile(resampled, [2.5, 97.5]))


def upper_bound(events: int, trials: int) -> float:
    """Returns Clopper and Pearson's one-sided bound: the probability at which so few events have a chance of 5 %."""
    return 1.0 if events >= trials else float(stats.beta.ppf(CONFIDENCE, events + 1, trials - events))
