"""The initiation and effect sets of many options, asked together."""

import numpy as np

from sb3_skillgraph.options.initiation import Boundary
from sb3_skillgraph.options.option import Option


class OptionBank:
    """Which of many options can start at a point, and which end where: one question for all of them.

    Every set is kept in a box. A question first asks all boxes, which is a few comparisons per set, and then only the
    sets whose boxes say maybe, in one batch. An option whose sets have changed is put in anew without a look at the rest.

    :param goal_dim: dimension of goal space
    """

    def __init__(self, goal_dim: int) -> None:
        self.options: list[Option] = []
        self._index: dict[str, int] = {}
        # Rows are dimensions, for comparisons to run along memory: corners of the boxes, and medians of the effects.
        self._lower = np.zeros((goal_dim, 16))
        self._upper = np.zeros((goal_dim, 16))
        self._middle = np.zeros((goal_dim, 16))

    def put(self, option: Option) -> None:
        """Take in an option, or what has changed about its sets.

        :param option: an option, new or known
        """
        i = self._index.setdefault(option.id, len(self.options))
        if i == len(self.options):
            self.options.append(option)
            if i == self._lower.shape[1]:
                for name in ("_lower", "_upper", "_middle"):
                    array = getattr(self, name)
                    setattr(self, name, np.concatenate([array, np.zeros_like(array)], axis=1))
        boundaries = option.initiation.optimistic_boundaries
        # NaN compares as False: no box to be in, no effects to be anywhere.
        self._lower[:, i], self._upper[:, i] = boundaries[0].box() if boundaries else (np.nan, np.nan)
        self._middle[:, i] = np.median(np.stack(option.effects), axis=0) if option.effects else np.nan

    def startable(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tell from which points which options can start.

        :param points: shape ``(n, goal_dim)``
        :return: indices of the options that can start from some of the points, ascending, shape ``(m,)``; a bool array
            of shape ``(n, m)``
        """
        points = np.asarray(points, dtype=np.float64)
        n = len(self.options)
        maybe = np.ones((len(points), n), dtype=bool)
        for column, lower, upper in zip(points.T, self._lower, self._upper, strict=True):
            maybe &= (column[:, None] >= lower[:n]) & (column[:, None] <= upper[:n])
        indices = np.flatnonzero(maybe.any(axis=0))
        if len(indices) == 0:
            return indices, np.zeros((len(points), 0), dtype=bool)
        inside = self._inside(indices, points)
        some = inside.any(axis=0)
        return indices[some], inside[:, some]

    def _inside(self, indices: np.ndarray, points: np.ndarray) -> np.ndarray:
        sets = [self.options[i].initiation.optimistic_boundaries for i in indices]
        boundaries: list[Boundary] = [boundary for one in sets for boundary in one]
        sizes = [len(boundary.weights) for boundary in boundaries]
        support = np.concatenate([boundary.support for boundary in boundaries])
        squared = np.einsum("ij,ij->i", points, points)[:, None] - 2.0 * points @ support.T
        squared += np.einsum("ij,ij->i", support, support)
        squared *= np.repeat([-boundary.gamma for boundary in boundaries], sizes)
        np.exp(squared, out=squared)
        squared *= np.concatenate([boundary.weights for boundary in boundaries])
        decisions = np.add.reduceat(squared, np.cumsum([0, *sizes[:-1]]), axis=1)
        decisions += [boundary.intercept for boundary in boundaries]
        return np.logical_and.reduceat(decisions > 0.0, np.cumsum([0, *map(len, sets[:-1])]), axis=1)

    def ending_in(self, lower: np.ndarray, upper: np.ndarray) -> list[Option]:
        """Return the options the middle of whose effects lies in a box.

        No other option can have more than half of its effects in there.

        :param lower: lower corner of the box, shape ``(goal_dim,)``
        :param upper: upper corner
        """
        middle = self._middle[:, : len(self.options)]
        inside = ((middle >= lower[:, None]) & (middle <= upper[:, None])).all(axis=0)
        return [self.options[i] for i in np.flatnonzero(inside)]
