"""Ways to propose salient events (section 3.2.1)."""

from collections.abc import Callable
from typing import Protocol

import numpy as np

from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.metric import Metric

#: The box around everything visited is grown by so many event radii, or by this share of its side, if that is more: what lies
#: just outside is worth a look, and a passage which leads out of a large box is to be nearest to more than a few proposals.
MARGIN, MARGIN_SHARE = 2.0, 0.1


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
    """

    def __init__(self, graph: SkillGraph) -> None:
        self.graph = graph

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        """Propose a point in or near the box; None before anything was visited."""
        if not self.graph.events:
            return None
        metric = self.graph.metric
        return metric.nearest_goal(rng.uniform(*box_around(self.graph.centers, metric)))


def box_around(points: np.ndarray, metric: Metric) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of a box that is a little larger than some points ask for, each of shape ``(goal_dim,)``.

    :param points: shape ``(n, goal_dim)``
    :param metric: of goal space
    """
    low, high, reach = points.min(axis=0), points.max(axis=0), metric.reach(points.shape[1])
    margin = np.maximum(MARGIN * reach, np.where(reach > 0.0, MARGIN_SHARE * (high - low), 0.0))
    return low - margin, high + margin
