"""What a goal with several units is made of: places, angles, rotations, and what has to match."""

import math
import operator
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_skillgraph.checking import HUGE


@dataclass(frozen=True)
class Part(ABC):
    """Some dimensions of a goal that are measured together.

    :param dims: which, counted from 0
    :raises TypeError: if they are no whole numbers
    """

    dims: Sequence[int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "dims", tuple(operator.index(i) for i in self.dims))

    @abstractmethod
    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return coordinates between which the Euclidean distance is 1 for points that are a radius apart.

        :param points: of these dimensions only, shape ``(..., len(dims))``
        """

    @property
    @abstractmethod
    def reach(self) -> float:
        """About how far off a goal may be in each of these dimensions; 0 where that means nothing."""

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return what could be part of a goal, shape ``(len(dims),)``."""
        return point


@dataclass(frozen=True)
class Within(Part):
    """Positions and other numbers: Euclidean distance.

    :param dims: which dimensions
    :param radius: within which they have to be, together
    """

    radius: float

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "radius", positive_radius(self.radius))

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return the numbers in radii."""
        return points / self.radius

    @property
    def reach(self) -> float:
        """The radius."""
        return self.radius


@dataclass(frozen=True)
class Angle(Within):
    """Angles, each the same after a whole turn.

    :param dims: which dimensions
    :param radius: within which they have to be, together, in radians
    """

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return points of circles on which the radius is a chord of length 1."""
        return np.concatenate([np.cos(points), np.sin(points)], axis=-1) / _chord(self.radius)

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return the angles between -pi and pi."""
        return (point + np.pi) % (2.0 * np.pi) - np.pi


@dataclass(frozen=True)
class Direction(Within):
    """A direction as a vector of length 1, such as a car's heading as its cosine and sine.

    :param dims: the dimensions of the vector
    :param radius: the angle, in radians, by which it may be off
    """

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return points of a circle, or sphere, on which the radius is a chord of length 1."""
        return _unit(points) / _chord(self.radius)

    @property
    def reach(self) -> float:
        """How much a number of the vector changes by a turn of the radius."""
        return math.sin(min(self.radius, 0.5 * math.pi))

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return the vector of length 1."""
        return _unit(point)


@dataclass(frozen=True)
class Rotation(Within):
    """A rotation in space as a unit quaternion (w, x, y, z), the same as its negative.

    :param dims: the four dimensions
    :param radius: the angle, in radians, by which it may be off
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if len(self.dims) != 4:
            raise ValueError(f"A rotation is a quaternion of 4 numbers, not of {len(self.dims)}.")

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return rotation matrices, shape ``(..., 9)``: the distance between two follows from the angle between them."""
        w, x, y, z = np.moveaxis(_unit(points), -1, 0)
        rows = [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
        matrices = np.stack([entry for row in rows for entry in row], axis=-1)
        return matrices / (np.sqrt(2.0) * _chord(self.radius))

    @property
    def reach(self) -> float:
        """How much a number of the quaternion changes by a turn of the radius."""
        return math.sin(0.5 * self.radius)

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return the quaternion of length 1."""
        return _unit(point)


@dataclass(frozen=True)
class Tilt(Rotation):
    """A rotation in space, whatever its turn about the body's own z axis: how a pen points.

    :param dims: the four dimensions of a quaternion (w, x, y, z)
    :param radius: the angle, in radians, by which it may be off when both are turned back
    """

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return rotation matrices, shape ``(..., 9)``, of the rotations about x and then y that are left."""
        w, x, y, z = np.moveaxis(_unit(points), -1, 0)
        # Where the z axis points tells both angles
        about_x = np.arctan2(2.0 * (w * x - y * z), 1.0 - 2.0 * (x * x + y * y)) / 2.0
        about_y = np.arcsin(np.clip(2.0 * (x * z + w * y), -1.0, 1.0)) / 2.0
        cos_x, sin_x, cos_y, sin_y = np.cos(about_x), np.sin(about_x), np.cos(about_y), np.sin(about_y)
        return super().embed(np.stack([cos_x * cos_y, sin_x * cos_y, cos_x * sin_y, sin_x * sin_y], axis=-1))


@dataclass(frozen=True)
class Exact(Part):
    """Whole numbers, such as whether a key has been fetched: they match, or a goal is not reached.

    :param dims: which dimensions
    """

    def embed(self, points: np.ndarray) -> np.ndarray:
        """Return the numbers as they are."""
        return points

    @property
    def reach(self) -> float:
        """Nothing between two values is a goal."""
        return 0.0

    def nearest_goal(self, point: np.ndarray) -> np.ndarray:
        """Return whole numbers."""
        return np.round(point)


def positive_radius(radius: Any) -> float:
    """Return a radius.

    :raises ValueError: if it is no positive number
    """
    if isinstance(radius, bool) or not isinstance(radius, int | float | np.number) or not 1.0 / HUGE <= radius <= HUGE:
        raise ValueError(f"event_radius must be a positive number up to {HUGE:g}, or a metric, not {radius!r}.")
    return float(radius)


def norm(vectors: np.ndarray) -> np.ndarray:
    """Return the Euclidean norms of vectors, shape ``(..., n)``."""
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors, shape ``(..., n)``, made as long as 1."""
    return vectors / np.maximum(norm(vectors)[..., None], 1e-9)


def _chord(angle: float) -> float:
    """Return the distance between two points of a circle of radius 1 that are an angle apart (half a turn at most)."""
    return 2.0 * math.sin(0.5 * min(angle, math.pi))
