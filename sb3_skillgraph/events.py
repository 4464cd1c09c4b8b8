"""Events: the places of goal space that a skill graph speaks of."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from sb3_skillgraph.metric import Metric, as_metric


class TerminationSet(Protocol):
    """Anything an option can end in: an event, or another option's initiation set."""

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell which points of goal space lie inside.

        :param points: float array of shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``
        """

    def holds(self, point: np.ndarray) -> bool:
        """Tell whether a single point lies inside: the question of every step, where batches cost too much.

        :param point: shape ``(goal_dim,)``
        """


@dataclass(frozen=True, eq=False)
class Event:
    """A ball in goal space, and a vertex of the skill graph (section 3.1).

    :param id: name of the event, and of its vertex
    :param center: centre of the ball, shape ``(goal_dim,)``, in the environment's goal units
    :param metric: how near is inside; a number is a radius, in goal units
    :param salient: whether the agent has pursued it as a target of its own (a *salient event*); a *landmark* just marks
        where the agent has been
    :raises ValueError: if the centre is not a finite vector or there is no such metric
    """

    id: str
    center: np.ndarray
    metric: Metric
    salient: bool = True

    def __post_init__(self) -> None:
        center = np.asarray(self.center, dtype=np.float64)
        if center.ndim != 1 or not np.isfinite(center).all():
            raise ValueError(f"Event {self.id!r} needs a finite centre of shape (goal_dim,), not {self.center!r}.")
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "metric", as_metric(self.metric))

    def __repr__(self) -> str:
        kind = "salient event" if self.salient else "landmark"
        return f"<{kind} {self.id} at ({', '.join(f'{x:.3g}' for x in self.center)}), within {self.metric!r}>"

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell which points trigger the event.

        :param points: float array of shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``
        """
        return self.metric.distance(np.asarray(points, dtype=np.float64), self.center) <= self.metric.radius

    def holds(self, point: np.ndarray) -> bool:
        """Tell whether a single point triggers the event.

        :param point: shape ``(goal_dim,)``
        """
        return self.metric.reached(point, self.center)

    def as_vertex(self) -> dict[str, Any]:
        """Return what its vertex carries in networkx, numbers and strings only."""
        place = {f"x{k}": float(x) for k, x in enumerate(self.center)}
        return {"kind": "event", "salient": self.salient, "radius": self.metric.radius, **place}

    def get_state(self) -> dict[str, Any]:
        """Return the event as plain data."""
        return {"id": self.id, "center": self.center, "salient": self.salient}
