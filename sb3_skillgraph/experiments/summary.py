"""Success over seeds: interquartile means and stratified bootstrap intervals (Agarwal et al. 2021)."""

from typing import NamedTuple

import numpy as np
from scipy.stats import trim_mean


class Estimate(NamedTuple):
    """An interquartile mean with its 95 % interval."""

    mean: float
    low: float
    high: float


def interquartile_mean(scores: np.ndarray) -> float:
    """Return the mean of the middle half of all scores.

    :param scores: any shape
    """
    return float(trim_mean(np.ravel(scores), 0.25))


def estimate(scores: np.ndarray, n_samples: int = 2_000, seed: int = 0) -> Estimate:
    """Estimate what another set of seeds would give.

    Seeds are drawn anew for each environment by itself, so that every environment keeps its weight.

    :param scores: shape ``(n_environments, n_seeds)``
    :param n_samples: bootstrap samples
    :param seed: of these samples
    """
    rng = np.random.default_rng(seed)
    n_environments, n_seeds = scores.shape
    drawn = rng.integers(n_seeds, size=(n_samples, n_environments, n_seeds))
    samples = scores[np.arange(n_environments)[None, :, None], drawn].reshape(n_samples, -1)
    low, high = np.quantile(trim_mean(samples, 0.25, axis=1), [0.025, 0.975])
    return Estimate(interquartile_mean(scores), float(low), float(high))
