"""What is expected of a walk that has not been tried: what walks of its kind have done."""

from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

#: Runs, at least, from which the model is learned; before that every walk is as good as the next.
MIN_RUNS = 30.0
#: Ridge on the coefficients of standardised features, in runs: few runs change little.
RIDGE = 3.0
#: Success of any walk before there are enough runs to learn from.
FIRST_GUESS = 0.5
#: Success below which a walk is of the doubtful kind: what its failures land in is learned apart.
DOUBTFUL = 0.5
N_FEATURES = 7


class Kind(NamedTuple):
    """What is known of some walks that have not been tried; arrays of shape ``(n,)``.

    :param distance: from where they begin to where they lead, in event radii
    :param steps: environment steps that trajectories took (forward, else backward); 0 where there are none
    :param forward: trajectories that went this way
    :param backward: trajectories that went the other way
    """

    distance: np.ndarray
    steps: np.ndarray
    forward: np.ndarray
    backward: np.ndarray

    def features(self) -> np.ndarray:
        """Return what the model goes by, shape ``(n, N_FEATURES)``.

        Walks whose way was seen forward, seen only backward and never seen at all are of three kinds, each with its own
        level; what nobody walks (far in few steps) is told by the speed.
        """
        seen = (self.forward > 0) | (self.backward > 0)
        only_backward = (self.forward == 0) & seen
        speed = np.where(seen, self.distance / np.maximum(self.steps, 1.0), 0.0)
        unseen = ~seen
        return np.stack(
            [
                np.log(self.distance + 0.1),
                speed,
                np.log1p(self.forward),
                only_backward,
                only_backward * speed,
                unseen,
                unseen * np.log(self.distance + 0.1),
            ],
            axis=1,
        )


class WalkModel:
    """Predicts success and steps of untried walks: logistic and linear regression on all runs so far.

    It is fitted while learning only. ``loss``: which share of failures ends far away or nowhere rather than near where
    the run began, for doubtful walks and for others.
    """

    def __init__(self) -> None:
        self.mean = np.zeros(N_FEATURES)
        self.scale = np.ones(N_FEATURES)
        self.coefficients = np.zeros(N_FEATURES)
        self.intercept = float(np.log(FIRST_GUESS / (1.0 - FIRST_GUESS)))
        self.pace = np.array([2.0, 1.0, 0.8])  # steps: a constant, for each radius of distance, for each step of a crossing
        self.steps_per_radius = 5.0  # of walks where nobody has gone
        self.loss = np.zeros(2)
        self.version = 0  # rises with every change

    def success(self, kind: Kind) -> np.ndarray:
        """Return the success rates to expect, shape ``(n,)``."""
        return expit((kind.features() - self.mean) / self.scale @ self.coefficients + self.intercept)

    def steps(self, kind: Kind) -> np.ndarray:
        """Return the environment steps that a successful run is expected to take, shape ``(n,)``, at least 1."""
        seen = (kind.forward > 0) | (kind.backward > 0)
        steps = np.where(seen, self._pace_features(kind) @ self.pace, self.steps_per_radius * kind.distance)
        return np.maximum(steps, 1.0)

    @staticmethod
    def _pace_features(kind: Kind) -> np.ndarray:
        return np.stack([np.ones_like(kind.distance), kind.distance, kind.steps], axis=1)

    def fit(self, kind: Kind, successes: np.ndarray, failures: np.ndarray, success_steps: np.ndarray) -> None:
        """Learn from runs.

        :param kind: what was known of their walks
        :param successes: weight of the successful runs of each walk, shape ``(n,)``
        :param failures: weight of those that failed
        :param success_steps: sum of the steps of the successful ones, weighted likewise
        """
        from sklearn.linear_model import LogisticRegression

        runs = successes + failures
        if runs.sum() < MIN_RUNS or successes.sum() < 1.0 or failures.sum() < 1.0:
            return
        tried = runs > 0.0
        features, weight = kind.features()[tried], runs[tried]
        self.mean = np.average(features, axis=0, weights=weight)
        self.scale = np.sqrt(np.average((features - self.mean) ** 2, axis=0, weights=weight)) + 1e-3
        standardised = np.tile((features - self.mean) / self.scale, (2, 1))
        outcomes = np.repeat([1, 0], len(features))
        weights = np.concatenate([successes[tried], failures[tried]])
        regression = LogisticRegression(C=1.0 / RIDGE, max_iter=200)
        regression.fit(standardised[weights > 0], outcomes[weights > 0], sample_weight=weights[weights > 0])
        self.coefficients, self.intercept = regression.coef_[0].copy(), float(regression.intercept_[0])
        self._fit_pace(kind, successes, success_steps)
        self.version += 1

    def _fit_pace(self, kind: Kind, successes: np.ndarray, success_steps: np.ndarray) -> None:
        reached = (successes > 0.0) & (kind.steps > 0.0)
        if not reached.any():
            return
        self.steps_per_radius = float(success_steps[reached].sum() / (successes * kind.distance)[reached].sum())
        features = self._pace_features(kind)[reached]
        root = np.sqrt(successes[reached])
        wanted = success_steps[reached] / successes[reached]
        ridge = np.sqrt(RIDGE) * np.eye(features.shape[1])
        left = np.concatenate([features * root[:, None], ridge])
        right = np.concatenate([wanted * root, ridge @ self.pace])  # towards what was learned before
        self.pace = np.linalg.lstsq(left, right, rcond=None)[0]

    def get_state(self) -> dict[str, Any]:
        """Return the coefficients as plain data."""
        return dict(vars(self))

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        vars(self).update(state)
