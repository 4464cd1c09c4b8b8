"""Ways to propose salient events (section 3.2.1)."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sb3_skillgraph.visited import VisitedStates


class Salience(Protocol):
    """Anything that proposes where a salient event could be."""

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        """Propose one centre.

        :param rng: random generator
        :return: a point of goal space, shape ``(goal_dim,)``; None if nothing can be proposed yet
        """


class RandomSalience:
    """Uniform samples of the feasible states, as an RRT draws them; needs an oracle (section 3.2.1, *Random sampling*).

    :param sample_free: the oracle: draws a feasible point of goal space from a generator
    """

    def __init__(self, sample_free: Callable[[np.random.Generator], np.ndarray]) -> None:
        self.sample_free = sample_free

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        """Propose a feasible point, wherever it is."""
        return np.asarray(self.sample_free(rng), dtype=np.float64)


class FrontierSalience:
    """The *extend* step of an RRT on visited states; needs no oracle.

    A point is drawn uniformly from the box around everything visited, grown by ``margin``; the visited state nearest
    to it is proposed, drawn back along the trajectory that reached it until it lies at most ``reach`` steps beyond the
    last event passed. Large unvisited regions draw events to their edge (the Voronoi bias), and every proposal is
    known to be reachable, and from where.

    :param visited: the agent's trajectories
    :param margin: growth of the box on every side, in goal units
    :param reach: steps beyond the last event at most
    """

    def __init__(self, visited: VisitedStates, margin: float, reach: int) -> None:
        self.visited = visited
        self.margin = margin
        self.reach = reach

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        """Propose a visited point near the frontier; None before anything was visited."""
        if self.visited.size == 0:
            return None
        nearest = int(self.visited.near(self.sample(rng), 0.0)[0])
        return self.visited.points[self.visited.rewind(nearest, self.reach)].astype(np.float64)

    def sample(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a point of the grown box, shape ``(goal_dim,)``."""
        points = self.visited.points
        return rng.uniform(points.min(axis=0) - self.margin, points.max(axis=0) + self.margin)
