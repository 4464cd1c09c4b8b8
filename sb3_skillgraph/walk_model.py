"""What is expected of a walk that has not been tried: what walks of its kind have done."""

import copy
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

#: Runs that the first guess counts for, beside those that there were.
GUESS_RUNS = 4.0
#: Ridge on the coefficients of standardised features, in runs: few runs change little.
RIDGE = 3.0
#: Success of any walk before there are runs to learn from: of a policy that has hardly been trained.
FIRST_GUESS = 0.25
#: Logit that success has at most, either way: nothing is sure of walks unlike any that was tried.
MOST_LOGIT = 30.0
#: A crossing is hasty that was so many times faster than the fastest walks, which are this quantile of all that succeed.
HASTY, FASTEST = 1.5, 0.1
#: Event radii from which on a walk is long: a run ends a radius before the centre, which is much of a short walk. Speed is
#: measured on long walks where there are so many.
LONG, ENOUGH_LONG = 3.0, 10
#: Success of hasty walks, and share of their failures that ends far away, before there are runs to learn from.
HASTY_GUESS, HASTY_LOSS = 0.1, 0.5
#: Least standard deviation of a feature: what never varies tells nothing.
LEAST_SCALE = 0.1
#: Success of walks that change what has to match in a way nobody has seen it change, before there are runs to learn from.
CHANGE_GUESS = 0.1
N_FEATURES = 7
#: Environment steps of failed runs that the first guess of their length counts for: about two runs.
PATIENCE_PRIOR = 100.0
#: A run may take so many times the steps that it is expected to take, and so many more: room for detours.
TIMES, MORE = 2.0, 15.0


def timeout(steps: Any) -> Any:
    """Return the environment steps that a run may take which is expected to succeed in ``steps``: a number, or an array."""
    return TIMES * steps + MORE


class Kind(NamedTuple):
    """What is known of some walks that have not been tried; arrays of shape ``(n,)``.

    :param distance: from where they begin to where they lead, in event radii
    :param steps: environment steps that trajectories took (forward, else backward); 0 where there are none
    :param forward: trajectories that went this way
    :param backward: trajectories that went the other way
    :param changes: which of what has to match (a key, a door) is another where they lead, shape ``(n, n_matched)``
    """

    distance: np.ndarray
    steps: np.ndarray
    forward: np.ndarray
    backward: np.ndarray
    changes: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """Whether any trajectory went this way or the other."""
        return (self.forward > 0) | (self.backward > 0)

    def features(self, fastest: float) -> np.ndarray:
        """Return what the model goes by, shape ``(n, N_FEATURES + n_matched)``.

        Walks whose way was seen forward, seen only backward and never seen at all are of three kinds, each with its own
        level; so are, for each of what has to match, those that would change it as nobody has seen it change.

        :param fastest: environment steps that the fastest walks take for a radius
        """
        length = np.log(self.distance + 0.1)
        backward = self.seen & (self.forward == 0)
        haste = self.haste(fastest)
        columns = [haste, length, np.log1p(self.forward), backward, backward * length, ~self.seen, ~self.seen * length]
        unheard_of = self.changes & (self.forward == 0)[:, None]
        return np.concatenate([np.stack(columns, axis=1), unheard_of], axis=1).astype(np.float64)

    def haste(self, fastest: float) -> np.ndarray:
        """Return by how much trajectories were faster than anybody walks (as a logarithm): luck, or no walk at all.

        :param fastest: environment steps that the fastest walks take for a radius
        """
        ratio = fastest * self.distance / np.maximum(self.steps, 1.0)
        return np.where(self.seen, np.log(np.maximum(ratio, 1.0)), 0.0)


class WalkModel:
    """Predicts success and steps of untried walks: logistic and linear regression on all runs so far.

    It is fitted while learning only. ``loss``: which share of failures ends far away or nowhere rather than near where
    the run began, for hasty walks and for others.

    :param n_matched: dimensions of a goal that have to match
    """

    def __init__(self, n_matched: int = 0) -> None:
        self.n_matched = n_matched
        self.mean = np.zeros(N_FEATURES + n_matched)
        self.scale = np.ones(N_FEATURES + n_matched)
        self.coefficients = np.zeros(N_FEATURES + n_matched)
        self.intercept = float(np.log(FIRST_GUESS / (1.0 - FIRST_GUESS)))
        self.pace = np.array([2.0, 1.0, 0.8])  # steps: a constant, for each radius of distance, for each step of a crossing
        self.steps_per_radius = 5.0  # of walks where nobody has gone
        self.fastest = 0.0  # steps that the fastest walks take for a radius
        self.loss = np.array([HASTY_LOSS, 0.0])
        self.patience = 1.0  # share of the steps it may take that a failed run takes: less where agents come to stand still
        self.n_runs = 0.0  # weight of the runs that it was learned from
        self.version = 0  # rises with every change

    def success(self, kind: Kind) -> np.ndarray:
        """Return the success rates to expect, shape ``(n,)``."""
        standardised = (kind.features(self.fastest) - self.mean) / self.scale
        logits = standardised @ self.coefficients + self.intercept
        return expit(np.clip(logits, -MOST_LOGIT, MOST_LOGIT))

    def is_hasty(self, kind: Kind) -> np.ndarray:
        """Tell which walks would have to be faster than any, shape ``(n,)``."""
        return kind.haste(self.fastest) > np.log(HASTY)

    def steps(self, kind: Kind) -> np.ndarray:
        """Return the environment steps that a successful run is expected to take, shape ``(n,)``, at least 1."""
        seen = _pace_features(kind) @ self.pace
        return np.maximum(np.where(kind.seen, seen, self.steps_per_radius * kind.distance), 1.0)

    def fit(self, kind: Kind, successes: np.ndarray, failures: np.ndarray, success_steps: np.ndarray) -> None:
        """Learn from runs.

        :param kind: what was known of their walks
        :param successes: weight of the successful runs of each walk, shape ``(n,)``
        :param failures: weight of those that failed
        :param success_steps: sum of the steps of the successful ones, weighted likewise
        """
        self.n_runs = float((successes + failures).sum())
        if not self.n_runs:
            return
        self._fit_pace(kind, successes, success_steps)
        self._fit_success(kind, successes, failures)
        self.version += 1

    def fit_failures(self, loss: np.ndarray, taken: float, allowed: float) -> None:
        """Learn from failed runs.

        :param loss: share of them that ended far away, of hasty walks and of others, shape ``(2,)``
        :param taken: environment steps that they took together
        :param allowed: environment steps that they might have taken
        """
        self.loss = loss
        self.patience = min((taken + PATIENCE_PRIOR) / (allowed + PATIENCE_PRIOR), 1.0)
        self.version += 1

    def _fit_success(self, kind: Kind, successes: np.ndarray, failures: np.ndarray) -> None:
        # Standardised, so that the ridge weighs all features alike
        features, weight = kind.features(self.fastest), successes + failures
        self.mean = np.average(features, axis=0, weights=weight)
        self.scale = np.sqrt(np.average((features - self.mean) ** 2, axis=0, weights=weight))
        self.scale = np.maximum(self.scale, LEAST_SCALE)
        # What is guessed first: the mean walk is one of a hardly trained policy, a hasty one hardly ever succeeds, nor one
        # that changes what nobody has seen to change so, for each of what has to match.
        hasty, unheard_of = self.mean.copy(), np.tile(self.mean, (self.n_matched, 1))
        hasty[0] = max(hasty[0], np.log(2.0 * HASTY))
        unheard_of[:, N_FEATURES:] = np.where(np.eye(self.n_matched, dtype=bool), 1.0, unheard_of[:, N_FEATURES:])
        guessed = np.concatenate([self.mean[None], hasty[None], unheard_of])
        guesses = np.array([FIRST_GUESS, HASTY_GUESS, *[CHANGE_GUESS] * self.n_matched])
        standardised = (np.concatenate([features, guessed]) - self.mean) / self.scale
        successes = np.concatenate([successes, GUESS_RUNS * guesses])
        failures = np.concatenate([failures, GUESS_RUNS * (1.0 - guesses)])
        tried = successes + failures > 0.0
        known = (standardised[tried], successes[tried], failures[tried])
        self.coefficients, self.intercept = logistic_regression(*known, RIDGE)

    def _fit_pace(self, kind: Kind, successes: np.ndarray, success_steps: np.ndarray) -> None:
        reached = (successes > 0.0) & (kind.steps > 0.0)
        if not reached.any():
            return
        taken, distance = success_steps[reached] / successes[reached], np.maximum(kind.distance[reached], 1e-3)
        self.steps_per_radius = float(success_steps[reached].sum() / (successes[reached] * distance).sum())
        pace, long = taken / distance, distance >= LONG
        if np.count_nonzero(long) >= ENOUGH_LONG:
            pace = taken[long] / (distance[long] - 1.0)
        self.fastest = float(np.quantile(pace, FASTEST))
        # Least squares, each walk weighted by its successful runs
        root = np.sqrt(successes[reached])
        ridge = np.sqrt(RIDGE) * np.eye(len(self.pace))
        left = np.concatenate([_pace_features(kind)[reached] * root[:, None], ridge])
        right = np.concatenate([taken * root, ridge @ self.pace])  # towards what was learned before
        self.pace = np.linalg.lstsq(left, right, rcond=None)[0]

    def get_state(self) -> dict[str, Any]:
        """Return the coefficients as plain data."""
        return copy.deepcopy(vars(self))

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        vars(self).update(copy.deepcopy(state))


def logistic_regression(
    features: np.ndarray, successes: np.ndarray, failures: np.ndarray, ridge: float
) -> tuple[np.ndarray, float]:
    """Return the coefficients and the intercept that make outcomes most likely.

    scikit-learn's would need its ninety megabytes in every process.

    :param features: shape ``(n, n_features)``
    :param successes: weight of each row's successes, shape ``(n,)``
    :param failures: weight of its failures
    :param ridge: weight of half the squared norm of the coefficients
    """
    from scipy.optimize import minimize  # when it is used: it takes a fifth of a second to import

    def loss(parameters: np.ndarray) -> tuple[float, np.ndarray]:
        coefficients, logits = parameters[:-1], features @ parameters[:-1] + parameters[-1]
        surprise = (successes + failures) * np.logaddexp(0.0, logits) - successes * logits
        excess = (successes + failures) * expit(logits) - successes
        gradient = np.append(features.T @ excess + ridge * coefficients, excess.sum())
        return float(surprise.sum() + 0.5 * ridge * coefficients @ coefficients), gradient

    parameters = minimize(loss, np.zeros(features.shape[1] + 1), jac=True, method="L-BFGS-B").x
    return parameters[:-1], float(parameters[-1])


def _pace_features(kind: Kind) -> np.ndarray:
    return np.stack([np.ones_like(kind.distance), kind.distance, kind.steps], axis=1)
