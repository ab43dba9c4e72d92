"""Aggregates over seeds."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy import stats

RESAMPLES = 10_000


def iqm(values: Float[np.ndarray, "... L"], axis: int = -1) -> Float[np.ndarray, "..."]:
    """Interquartile mean: without the lowest and the highest quarter, so of five the mean of three (Agarwal et al. 2021)."""
    return stats.trim_mean(values, 0.25, axis=axis)


def iqm_interval(values: Float[np.ndarray, "L"], confidence: float = 0.95) -> tuple[float, float]:
    """Percentile bootstrap interval of the interquartile mean, the same on every call; a point for a single value."""
    if values.size < 2:
        return float(values[0]), float(values[0])
    result = stats.bootstrap(
        (values,), iqm, confidence_level=confidence, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    )
    return float(result.confidence_interval.low), float(result.confidence_interval.high)
