"""Salient events: the states an agent has decided are worth reaching."""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np


class TerminationSet(Protocol):
    """Anything an option can end in: a salient event, or another option's initiation set."""

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
class SalientEvent:
    """A ball in goal space that the agent treats as a target of its own (section 3.1).

    :param id: name of the event, and of its vertex in the skill graph
    :param center: centre of the ball, shape ``(goal_dim,)``, in the environment's goal units
    :param radius: radius of the ball, same units
    :raises ValueError: if the centre is not a finite vector or the radius is not positive
    """

    id: str
    center: np.ndarray
    radius: float

    def __post_init__(self) -> None:
        center = np.asarray(self.center, dtype=np.float64)
        if center.ndim != 1 or not np.isfinite(center).all():
            raise ValueError(f"Event {self.id!r} needs a finite centre of shape (goal_dim,), not {self.center!r}.")
        if not self.radius > 0:
            raise ValueError(f"Event {self.id!r} needs a positive radius, not {self.radius!r}.")
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "_coordinates", center.tolist())

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell which points trigger the event.

        :param points: float array of shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``
        """
        offsets = np.asarray(points, dtype=np.float64) - self.center
        return np.einsum("ij,ij->i", offsets, offsets) <= self.radius**2

    def holds(self, point: np.ndarray) -> bool:
        """Tell whether a single point triggers the event.

        :param point: shape ``(goal_dim,)``
        """
        return math.dist(point.tolist(), self._coordinates) <= self.radius  # type: ignore[attr-defined]

    def outline(self) -> np.ndarray:
        """Return points that stake out the event: its centre, and its rim along every axis; shape ``(n, goal_dim)``."""
        axes = self.radius * np.eye(len(self.center))
        return np.concatenate([self.center[None], self.center + axes, self.center - axes])

    def get_state(self) -> dict[str, Any]:
        """Return the event as plain data."""
        return {"id": self.id, "center": self.center, "radius": self.radius}


class EventBank:
    """Many events together: one question for all of them.

    :param goal_dim: dimension of goal space
    """

    def __init__(self, goal_dim: int) -> None:
        self.events: list[SalientEvent] = []
        self._index: dict[str, int] = {}
        self._centers = np.zeros((16, goal_dim))
        self._radii = np.zeros(16)
        self._middle = np.zeros((16, goal_dim))

    def add(self, event: SalientEvent) -> None:
        """Take in a new event."""
        i = self._index[event.id] = len(self.events)
        self.events.append(event)
        if i == len(self._radii):
            for name in ("_centers", "_radii", "_middle"):
                array = getattr(self, name)
                setattr(self, name, np.concatenate([array, np.zeros_like(array)]))
        self._centers[i], self._radii[i], self._middle[i] = event.center, event.radius, event.center

    def triggered(self, event: SalientEvent, points: np.ndarray) -> None:
        """Note where an event has been triggered lately.

        :param event: a known event
        :param points: shape ``(n, goal_dim)``
        """
        self._middle[self._index[event.id]] = np.median(points, axis=0)

    def shares(self, points: np.ndarray) -> np.ndarray:
        """Return which share of some points lies in each event.

        :param points: shape ``(n, goal_dim)``
        :return: shape ``(n_events,)``
        """
        n = len(self.events)
        offsets = np.asarray(points, dtype=np.float64)[:, None] - self._centers[:n]
        return (np.einsum("ijk,ijk->ij", offsets, offsets) <= self._radii[:n] ** 2).mean(axis=0)

    def holding(self, point: np.ndarray) -> list[SalientEvent]:
        """Return the events that a point lies in.

        :param point: shape ``(goal_dim,)``
        """
        return [self.events[i] for i in np.flatnonzero(self.shares(point[None]))]

    def triggered_in(self, lower: np.ndarray, upper: np.ndarray) -> list[SalientEvent]:
        """Return the events the middle of whose trigger points lies in a box.

        No other event can have more than half of them in there.

        :param lower: lower corner of the box, shape ``(goal_dim,)``
        :param upper: upper corner
        """
        middle = self._middle[: len(self.events)]
        return [self.events[i] for i in np.flatnonzero(((middle >= lower) & (middle <= upper)).all(axis=1))]
