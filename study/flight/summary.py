"""Statistics over episodes: robust summaries (Agarwal et al. 2021) and the bound on a rare event's probability."""

import numpy as np
from scipy import stats

RESAMPLES = 10_000
STRATIFIED_RESAMPLES = 50_000
AT_ONCE = 2**21  # scores of the resamples held in memory
CONFIDENCE = 0.95  # of the bound


def iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: the mean of the middle half, by scipy's trimmed mean."""
    return stats.trim_mean(values, 0.25, axis=axis)


def tail(values: np.ndarray) -> dict[str, float]:
    """The 5th and 95th percentile and the largest of all values."""
    p5, p95 = np.percentile(values, [5.0, 95.0])
    return {"p5": float(p5), "p95": float(p95), "max": float(values.max())}


def summary(values: np.ndarray, seed: int = 0) -> dict[str, float | list[float]]:
    """`iqm`, `mean`, `tail`, and `ci95`, the percentile bootstrap's 95 % interval of the IQM, of (episodes,) values."""
    if np.ptp(values) == 0.0:
        interval = [float(values[0])] * 2  # scipy's bootstrap has no interval for a constant
    else:
        result = stats.bootstrap(
            (values,),
            iqm,
            n_resamples=RESAMPLES,
            method="percentile",
            rng=np.random.default_rng(seed),
            batch=1000,
        )
        interval = [float(bound) for bound in result.confidence_interval]
    return {"iqm": float(iqm(values)), "mean": float(values.mean()), "ci95": interval} | tail(values)


def stratified_bootstrap(
    scores: np.ndarray, rng: np.random.Generator, resamples: int = STRATIFIED_RESAMPLES
) -> np.ndarray:
    """IQMs (resamples,) of stratified bootstrap resamples of scores (runs, tasks).

    As Agarwal et al. define it (2021, Sec. 4): each task is a stratum, whose runs are drawn with replacement
    independently of the other tasks'.
    """
    size = max(1, AT_ONCE // scores.size)
    iqms = []
    for start in range(0, resamples, size):
        drawn = rng.integers(len(scores), size=(min(size, resamples - start), *scores.shape))
        resampled = np.take_along_axis(scores[None], drawn, axis=1)
        iqms.append(iqm(resampled.reshape(len(drawn), -1)))
    return np.concatenate(iqms)


def stratified_summary(scores: np.ndarray, seed: int = 0) -> dict[str, float | list[float]]:
    """`iqm`, `mean` and `tail` of all of the scores (runs, tasks), and `ci95`, the stratified bootstrap's interval."""
    low, high = np.percentile(stratified_bootstrap(scores, np.random.default_rng(seed)), [2.5, 97.5])
    return {
        "iqm": float(iqm(scores, axis=None)),
        "mean": float(scores.mean()),
        "ci95": [float(low), float(high)],
    } | tail(scores)


def summary_of_runs(scores: np.ndarray) -> dict[str, float | list[float]]:
    """`stratified_summary` of scores (runs, tasks); of a lone run, `summary` over its tasks."""
    return summary(scores[0]) if len(scores) == 1 else stratified_summary(scores)


def upper_bound(events: int, trials: int) -> float:
    """Clopper and Pearson's one-sided bound: the probability at which so few events had a chance of 5 %."""
    return 1.0 if events >= trials else float(stats.beta.ppf(CONFIDENCE, events + 1, trials - events))
