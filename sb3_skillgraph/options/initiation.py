"""Initiation sets: where an option can start, learned from where it succeeded and failed (sections 2.1, 2.2).

scikit-learn fits the support vector machines, NumPy evaluates them: a membership question costs microseconds.
"""

from collections import deque
from typing import Any, NamedTuple

import numpy as np

# Successes cover an option's region densely, so few trajectories with few points each describe it well.
N_SUCCESSES, POINTS_PER_SUCCESS, N_FAILURES = 40, 12, 30


class Boundary(NamedTuple):
    """The decision function of a fitted RBF support vector machine, as plain arrays.

    ``support``: shape ``(m, goal_dim)``; ``weights``: shape ``(m,)``.
    """

    support: np.ndarray
    weights: np.ndarray
    intercept: float
    gamma: float

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return how far points lie on the positive side, as the machine measures it.

        :param points: shape ``(n, goal_dim)``
        :return: shape ``(n,)``, positive inside
        """
        return np.exp(-self.gamma * _squared_distances(points, self.support)) @ self.weights + self.intercept


class InitiationSet:
    """Where an option can start, twice: optimistic and pessimistic.

    *Optimistic*: the region of all successes, less what the failures took away; an option may be *started* there.
    *Pessimistic*: the core of that region; what another option may *aim at*, so that reaching it is sure to let this
    option start. A success that passes where an earlier attempt failed outvotes that failure, so the set follows the
    policy as it improves.

    :param radius: the resolution of the set, in goal units: two states nearer than half of it count as the same place
    """

    def __init__(self, radius: float) -> None:
        self.radius = radius
        self.successes: deque[np.ndarray] = deque(maxlen=N_SUCCESSES)
        self.failures: deque[np.ndarray] = deque(maxlen=N_FAILURES)
        self.optimistic_boundaries: list[Boundary] = []
        self.pessimistic_boundaries: list[Boundary] = []
        self.core: np.ndarray | None = None
        self._n_news = 0

    def add_success(self, path: np.ndarray) -> None:
        """Remember the way of a successful run.

        :param path: the states from its start to before its end, shape ``(n, goal_dim)``, ``n >= 1``
        """
        chosen = np.unique(np.linspace(0, len(path) - 1, POINTS_PER_SUCCESS).astype(int))
        self.successes.append(np.asarray(path, dtype=np.float64)[chosen])
        self._n_news += 1

    def add_failure(self, start: np.ndarray) -> None:
        """Remember where a failed run began.

        :param start: shape ``(goal_dim,)``
        """
        self.failures.append(np.asarray(start, dtype=np.float64))
        self._n_news += 1

    def refit(self, force: bool = False) -> bool:
        """Fit the set to its examples, if enough of them are new.

        :param force: fit if anything at all is new
        :return: whether the set was fitted
        """
        known = len(self.successes)
        if not known or not self._n_news or not (force or self._n_news * 5 >= known):
            return False
        self._n_news = 0
        import sklearn  # when it is used: it takes a second to import

        # What scikit-learn would check takes it longer than the fit.
        with sklearn.config_context(assume_finite=True, skip_parameter_validation=True):
            self._fit()
        return True

    def _fit(self) -> None:
        from sklearn.svm import SVC

        positives = np.concatenate(self.successes)
        negatives = self._standing_failures()
        # A floor under the kernel's width: a handful of points in one spot still describe a place, not a point.
        gamma = 1.0 / (positives.shape[1] * max(float(positives.var()), (0.5 * self.radius) ** 2))
        self.optimistic_boundaries = [_one_class(positives, 0.01, gamma)]
        accepted = positives
        if len(negatives):
            classes = np.repeat([1, 0], [len(positives), len(negatives)])
            points = np.concatenate([positives, negatives])
            machine = SVC(kernel="rbf", gamma=gamma, class_weight="balanced").fit(points, classes)
            split = Boundary(machine.support_vectors_, machine.dual_coef_[0], float(machine.intercept_[0]), gamma)
            inside = split.depth(positives) > 0.0
            # A split that leaves no success on its side says nothing of where: that the option fails is for its rate.
            if inside.any():
                self.optimistic_boundaries.append(split)
                accepted = positives[inside]
        # What another option aims at must be somewhere this one can start: the core lies inside the optimistic set.
        self.pessimistic_boundaries = [_one_class(accepted, 0.1, gamma), *self.optimistic_boundaries]
        # The surest thing to aim at: the example furthest inside
        self.core = accepted[self.pessimistic_boundaries[0].depth(accepted).argmax()]

    def _standing_failures(self) -> np.ndarray:
        """Return the failed starts that later successes have not outvoted, shape ``(n, goal_dim)``."""
        if not self.failures:
            return np.zeros((0, self.successes[0].shape[1]))
        failures = np.stack(self.failures)
        near = (0.5 * self.radius) ** 2
        against = (_squared_distances(failures, failures) <= near).sum(axis=1)
        passed = [(_squared_distances(failures, path) <= near).any(axis=1) for path in self.successes]
        return failures[against > np.sum(passed, axis=0)]

    def optimistic(self, points: np.ndarray) -> np.ndarray:
        """Tell from which points the option may be started.

        :param points: shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``, all False before the first fit
        """
        return _inside_all(self.optimistic_boundaries, points)

    def pessimistic(self, points: np.ndarray) -> np.ndarray:
        """Tell which points another option may aim at.

        :param points: shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``, all False before the first fit
        """
        return _inside_all(self.pessimistic_boundaries, points)

    def get_state(self) -> dict[str, Any]:
        """Return examples and boundaries as plain data."""
        return {
            "successes": list(self.successes),
            "failures": list(self.failures),
            "optimistic": [boundary._asdict() for boundary in self.optimistic_boundaries],
            "pessimistic": [boundary._asdict() for boundary in self.pessimistic_boundaries],
            "core": self.core,
            "n_news": self._n_news,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.successes = deque(state["successes"], maxlen=N_SUCCESSES)
        self.failures = deque(state["failures"], maxlen=N_FAILURES)
        self.optimistic_boundaries = [Boundary(**boundary) for boundary in state["optimistic"]]
        self.pessimistic_boundaries = [Boundary(**boundary) for boundary in state["pessimistic"]]
        self.core = state["core"]
        self._n_news = state["n_news"]


def _one_class(points: np.ndarray, nu: float, gamma: float) -> Boundary:
    from sklearn.svm import OneClassSVM

    machine = OneClassSVM(kernel="rbf", nu=nu, gamma=gamma).fit(points)
    # A hair of slack: libsvm leaves its own margin vectors a rounding error outside.
    return Boundary(machine.support_vectors_, machine.dual_coef_[0], float(machine.intercept_[0]) + 1e-3, gamma)


def _inside_all(boundaries: list[Boundary], points: np.ndarray) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    inside = np.full(len(points), bool(boundaries))
    for boundary in boundaries:
        inside &= boundary.depth(points) > 0.0
    return inside


def _squared_distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return ((a[:, None, :] - b[None, :, :]) ** 2).sum(axis=2)
