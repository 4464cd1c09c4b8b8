"""How far apart two goals are, and when one counts as reached: the unit of everything that lives in goal space."""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_skillgraph.metric_parts import Angle, Direction, Exact, Part, Rotation, Tilt, Within, norm, positive_radius

__all__ = ["Angle", "Ball", "Custom", "Direction", "Exact", "Metric", "MetricFunction", "Part", "Product", "Rotation"]
__all__ += ["Tilt", "Within", "as_metric", "as_saved"]

#: Radii by which goals are apart, beside all else, for every dimension that has to match and does not: no event may be so
#: large.
MISMATCH = 1_000.0
#: Values of a dimension that has to match are the same up to this difference: whole numbers are told apart.
SAME = 0.5


class Metric(ABC):
    """A distance between goals; who is within ``radius`` of a goal has reached it.

    Points are arrays of shape ``(..., goal_dim)``; leading axes are broadcast.
    """

    radius: float
    #: Dimensions that have to match.
    n_matched: int = 0

    @abstractmethod
    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return how far apart points are, shape ``(...)``."""

    def travel(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return how far one has to go from one point to another, in radii, shape ``(...)``: without what has to match."""
        return self.distance(a, b) / self.radius

    def mismatches(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Tell which of what has to match does not, bool array of shape ``(..., n)``."""
        return np.zeros((*np.broadcast_shapes(np.shape(a), np.shape(b))[:-1], 0), dtype=bool)

    def reached(self, point: np.ndarray, goal: np.ndarray) -> bool:
        """Tell whether who stands at a point, shape ``(goal_dim,)``, has reached a goal of the same shape."""
        return bool(self.distance(point, goal) <= self.radius)

    @abstractmethod
    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return what networks see of points, float32 of shape ``(..., n)``: numbers in which a radius is about 1."""

    @abstractmethod
    def reach(self, goal_dim: int) -> np.ndarray:
        """Return about how far off a goal may be in each dimension, shape ``(goal_dim,)``; 0 where that means nothing."""

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return what could be a goal instead of a point that was made up, same shape ``(goal_dim,)``."""
        return point

    def beyond(self, begin: np.ndarray, point: np.ndarray, radii: float) -> np.ndarray:
        """Return a point on the way from one point to another and so many radii past it, shape ``(goal_dim,)``."""
        length = max(float(self.travel(begin, point)), 1e-9)
        return self.nearest_goal(np.where(self.reach(len(point)) > 0.0, point + radii / length * (point - begin), point))

    def check(self, goal_dim: int) -> None:  # noqa: B027
        """Refuse goals of another length.

        :raises ValueError: if the metric is none of goals of that length
        """


@dataclass(frozen=True)
class Ball(Metric):
    """Euclidean distance, in the environment's goal units.

    :param radius: within which a goal is reached
    :raises ValueError: if it is no positive number
    """

    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive_radius(self.radius))

    def __repr__(self) -> str:
        return f"{self.radius:g}"

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the Euclidean distance, shape ``(...)``."""
        return norm(a - b)

    def reached(self, point: np.ndarray, goal: np.ndarray) -> bool:
        """Tell whether a goal is reached: asked at every step, where arrays cost too much."""
        return math.dist(point.tolist(), goal.tolist()) <= self.radius

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return points in radii."""
        return points / np.float32(self.radius)

    def reach(self, goal_dim: int) -> np.ndarray:
        """Return the radius, for all dimensions."""
        return np.full(goal_dim, self.radius)


class Product(Metric):
    """A goal is reached where every part of it is: dimensions that belong to none do not matter.

    The distance is that of the part that is furthest off, in its own radii; where something does not match that has to, goals
    are far apart.

    :param parts: the parts
    :raises ValueError: if they are none, none can be measured, or two have a dimension in common

    >>> metric = Product(Within([0, 1], 0.5), Angle([2], 0.2), Exact([3]))
    >>> round(float(metric.travel(np.array([0.0, 0.0, 3.1, 1.0]), np.array([0.0, 0.0, -3.1, 1.0]))), 2)
    0.42
    >>> metric.reached(np.array([0.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0]))  # the key has not been fetched
    False
    """

    radius = 1.0

    def __init__(self, *parts: Part) -> None:
        if not all(isinstance(part, Part) and part.dims for part in parts):
            raise ValueError(f"event_radius is made of parts, such as Within([0, 1], 0.1), not of {list(parts)}.")
        dims = [i for part in parts for i in part.dims]
        if not any(isinstance(part, Within) for part in parts) or len(set(dims)) < len(dims) or min(dims) < 0:
            raise ValueError(f"event_radius needs parts with a radius, and each dimension at most once, not {list(parts)}.")
        self.parts = parts
        self.length: int | None = None  # of goals, where a radius was given for each dimension
        self._measured = [part for part in parts if isinstance(part, Within)]
        self._matched = [i for part in parts if isinstance(part, Exact) for i in part.dims]
        self.n_matched = len(self._matched)

    def check(self, goal_dim: int) -> None:
        """Refuse goals that have not all of the dimensions, or others than there are radii for."""
        if self.length not in (None, goal_dim):
            raise ValueError(f"event_radius has {self.length} radii for goals that have {goal_dim} dimensions.")
        last = max(i for part in self.parts for i in part.dims)
        if last >= goal_dim:
            raise ValueError(f"event_radius speaks of dimension {last} (counted from 0) of goals that have {goal_dim}.")

    def __repr__(self) -> str:
        return f"Product({', '.join(map(repr, self.parts))})"

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the distance, in radii, shape ``(...)``."""
        return self.travel(a, b) + MISMATCH * self.mismatches(a, b).sum(axis=-1)

    def mismatches(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Tell which of the dimensions differ that have to match, shape ``(..., n)``."""
        return np.abs(np.asarray(a)[..., self._matched] - np.asarray(b)[..., self._matched]) > SAME

    def travel(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return how far off the part is that is furthest off, shape ``(...)``."""
        a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        dims = [list(part.dims) for part in self._measured]
        away = [norm(part.embed(a[..., i]) - part.embed(b[..., i])) for part, i in zip(self._measured, dims, strict=True)]
        return np.max(np.broadcast_arrays(*away), axis=0)

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return what all parts see, one after the other."""
        seen = [part.embed(points[..., list(part.dims)]) for part in self.parts]
        return np.concatenate(seen, axis=-1).astype(np.float32)

    def reach(self, goal_dim: int) -> np.ndarray:
        """Return the radii of the parts."""
        result = np.zeros(goal_dim)
        for part in self.parts:
            result[list(part.dims)] = part.reach
        return result

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return a point with whole angles, quaternions and values in place of those that were made up."""
        point = np.array(point, dtype=np.float64)
        for part in self.parts:
            point[list(part.dims)] = part.nearest_goal(point[list(part.dims)])
        return point


class Custom(Metric):
    """A user's own distance; it is saved by name only.

    :param function: ``(a, b) -> distance`` of arrays of shape ``(..., goal_dim)``, 1 and less where a goal is reached
    """

    radius = 1.0

    def __init__(self, function: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> None:
        self.function = function
        self._known_units: dict[int, np.ndarray] = {}  # by length of a goal

    def __repr__(self) -> str:
        return getattr(self.function, "__name__", repr(self.function))

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return what the function returns, shape ``(...)``."""
        return np.asarray(self.function(np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)))

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return points in their units; what does not matter is 0, whatever it is."""
        return (points / self._units(np.shape(points)[-1])).astype(np.float32)

    def reach(self, goal_dim: int) -> np.ndarray:
        """Return the units of all dimensions, 0 of those that do not matter."""
        units = self._units(goal_dim)
        return np.where(np.isfinite(units), units, 0.0)

    def _units(self, goal_dim: int) -> np.ndarray:
        """Return how far off a goal is that is no longer reached, in each dimension alone, from 0 on, to a factor of two.

        It is infinite where the function does not look, and 1 where a goal is always reached all the same.
        """
        if goal_dim not in self._known_units:
            far = 2.0 ** np.arange(-30.0, 31.0)
            goals = far[:, None, None] * np.eye(goal_dim)
            away = self.distance(np.zeros_like(goals), goals)  # (distances, dimensions)
            missed = away > self.radius
            units = np.where(missed.any(axis=0), far[missed.argmax(axis=0)], 1.0)
            self._known_units[goal_dim] = np.where((away == 0.0).all(axis=0), np.inf, units)
        return self._known_units[goal_dim]

    def check(self, goal_dim: int) -> None:
        """Refuse a function that does not take many points at once, or whose distances are none."""
        points = 1e-3 * (1.0 + np.arange(6.0 * goal_dim)).reshape(3, 2, goal_dim)  # small: as far as any function goes
        away = self.distance(points, points[0])
        shape = away.shape
        if shape != (3, 2):
            raise ValueError(
                f"event_radius={self!r} must return a distance for each of many points, shape (...) for points of shape "
                f"(..., goal_dim); of shape (3, 2, {goal_dim}) it returned shape {shape}. With np.linalg.norm, give axis=-1."
            )
        if not (np.isfinite(away) & (away >= 0.0)).all():
            raise ValueError(f"event_radius={self!r} must return finite distances, 0 or more, and returned {away.tolist()}.")


#: A user's own distance, in radii.
MetricFunction = Callable[[np.ndarray, np.ndarray], np.ndarray]
_PARTS = {part.__name__: part for part in (Within, Angle, Direction, Rotation, Tilt, Exact)}


def as_metric(given: Any) -> Metric:
    """Return the metric that is meant.

    :param given: a metric, or what one is made of: a radius; a radius for each dimension (infinite where it does not matter);
        a function ``(a, b) -> distance`` in radii; or what :func:`as_saved` returned
    :raises ValueError: if it is none of these

    >>> as_metric(0.45).reached(np.array([0.0, 0.0]), np.array([0.3, 0.3]))
    True
    >>> heading = as_metric([0.1, np.inf])  # the second dimension does not matter
    >>> heading.reached(np.array([0.0, 5.0]), np.array([0.05, -5.0]))
    True
    """
    if isinstance(given, Metric):
        return given
    if callable(given):
        return Custom(given)
    if isinstance(given, dict) and given.get("parts"):
        return Product(*(_part(**spec) for spec in given["parts"]))
    if isinstance(given, list | tuple | np.ndarray) and np.ndim(given) == 1:
        product = Product(*(Within((i,), radius) for i, radius in enumerate(given) if radius != np.inf))
        product.length = len(given)
        return product
    return Ball(given)


def _part(kind: Any = None, **arguments: Any) -> Part:
    if kind not in _PARTS:
        raise ValueError(f"event_radius: a part is of kind {', '.join(_PARTS)}, not {kind!r}.")
    try:
        return _PARTS[kind](**arguments)
    except TypeError as error:
        raise ValueError(f"event_radius: {kind} cannot be made of {arguments}: {error}.") from error


def as_saved(metric: Metric) -> Any:
    """Return what a file can keep of a metric: what :func:`as_metric` makes it of, or itself, of which only the name is kept.

    :param metric: of one of these classes, or of a user's own
    """
    if type(metric) is Ball:
        return metric.radius
    if type(metric) is Custom:
        return metric.function
    if type(metric) is Product and all(type(part) in _PARTS.values() for part in metric.parts):
        return {"parts": [{"kind": type(part).__name__, **vars(part)} for part in metric.parts]}
    return metric
