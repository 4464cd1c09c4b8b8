"""The fewest steps from one place to another in OGBench's point mazes."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from sb3_skillgraph.envs import MazeGeometry

STEP, BODY = 0.2, 0.7  # what an action of 1 moves the point, and what it keeps from walls, in world units


class Shortest:
    """The fewest steps from one place to another.

    :param geometry: the maze
    :param radius: distance within which a goal counts as reached, in world units
    """

    def __init__(self, geometry: MazeGeometry, radius: float) -> None:
        left, right, bottom, top = geometry.extent
        self.corner = np.array([left, bottom])
        xs, ys = np.arange(left, right, STEP), np.arange(bottom, top, STEP)
        self.grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
        self.free = np.array([[geometry.has_room(x, y, BODY) for y in ys] for x in xs])
        self.radius = radius

    def __call__(self, start: NDArray[np.float64], goal: NDArray[np.float64]) -> int:
        """Return the number of moves.

        :param start: shape (2,)
        :param goal: shape (2,)
        """
        seen = (np.linalg.norm(self.grid - goal, axis=-1) <= self.radius) & self.free
        # The free place of the grid nearest to the start.
        distance = np.where(self.free, np.linalg.norm(self.grid - start, axis=-1), np.inf)
        here = np.unravel_index(distance.argmin(), distance.shape)
        for n_moves in range(10_000):
            if seen[here]:
                return n_moves
            seen = binary_dilation(seen, np.ones((3, 3))) & self.free
        raise ValueError("No way leads there.")
