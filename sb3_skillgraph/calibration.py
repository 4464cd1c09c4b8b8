"""What plans promised, beside what happened."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class CalibrationBin(NamedTuple):
    """Plans of about the same promised success.

    :param low: where the bin begins
    :param n_plans: number of plans in it
    :param promised: their mean success probability
    :param observed: share of them whose goal was reached
    """

    low: float
    n_plans: int
    promised: float
    observed: float


def calibration(promises: Sequence[tuple[float, bool]], n_bins: int = 5) -> list[CalibrationBin]:
    """Compare what plans promised with what happened.

    :param promises: the promised success of each plan, and whether the goal was reached
    :param n_bins: number of equally wide bins of the promised success
    :return: the bins that hold plans, lowest first

    >>> calibration([(0.9, True), (0.95, False)], n_bins=2)
    [CalibrationBin(low=0.5, n_plans=2, promised=0.925, observed=0.5)]
    """
    bins = []
    for i in range(n_bins):
        inside = [plan for plan in promises if min(int(plan[0] * n_bins), n_bins - 1) == i]
        if inside:
            promised, observed = np.mean(inside, axis=0).tolist()
            bins.append(CalibrationBin(i / n_bins, len(inside), promised, observed))
    return bins


def brier_score(promises: Sequence[tuple[float, bool]]) -> float:
    """Return the mean squared difference between what was promised and what happened: 0 is best.

    >>> brier_score([(1.0, True), (0.5, False)])
    0.125
    """
    return float(np.mean([(promised - success) ** 2 for promised, success in promises]))
