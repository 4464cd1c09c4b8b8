"""Ways to propose salient events (section 3.2.1)."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sb3_skillgraph.graph import SkillGraph

#: Event radii by which the box around everything visited is grown: what lies just outside is worth a look.
MARGIN = 2.0


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
    """Uniform samples of the box around everything visited, a little larger; needs no oracle.

    The agent goes to the event nearest to the sample and on from there: large unvisited regions draw it to their edge
    (the Voronoi bias of an RRT, section 2.4).

    :param graph: the skill graph, whose events lie all over what has been visited
    :param goal: a place that the box is to hold as well, shape ``(goal_dim,)``; None for none
    """

    def __init__(self, graph: SkillGraph, goal: np.ndarray | None = None) -> None:
        self.graph = graph
        self.goal = goal

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        """Propose a point in or near the box; None before anything was visited."""
        if not self.graph.events:
            return None
        lower, upper = self.box()
        return rng.uniform(lower, upper)

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the corners of the box, each of shape ``(goal_dim,)``."""
        inside, margin = self.graph.centers, MARGIN * self.graph.radius
        if self.goal is not None:
            inside = np.concatenate([inside, self.goal[None]])
        return inside.min(axis=0) - margin, inside.max(axis=0) + margin
