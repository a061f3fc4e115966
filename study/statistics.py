"""Robust summaries over episodes (Agarwal et al. 2021): the interquartile mean and its bootstrap interval."""

import numpy as np
from scipy import stats

RESAMPLES = 10_000


def iqm(values: np.ndarray, axis: int = -1) -> np.ndarray:
    """Interquartile mean: the mean of the middle half, by scipy's trimmed mean."""
    return stats.trim_mean(values, 0.25, axis=axis)


def summary(values: np.ndarray, seed: int = 0) -> dict[str, float | list[float]]:
    """`iqm`, `mean` and `ci95`, the percentile bootstrap's 95 % interval of the IQM, of (episodes,) values."""
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
    return {"iqm": float(iqm(values)), "mean": float(values.mean()), "ci95": interval}
