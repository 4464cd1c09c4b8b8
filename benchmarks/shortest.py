"""The fewest steps from one place to another in OGBench's point mazes."""

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from sb3_skillgraph.envs import MazeGeometry

STEP, BODY = 0.2, 0.7  # what an action of 1 moves the point, and what it keeps from walls, in world units


class Shortest:
    """The fewest steps from one place to another, by king moves on a grid.

    :param geometry: the maze
    :param radius: distance within which a goal counts as reached, in world units
    """

    def __init__(self, geometry: MazeGeometry, radius: float) -> None:
        left, right, bottom, top = geometry.extent
        xs, ys = np.arange(left, right, STEP), np.arange(bottom, top, STEP)
        grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), axis=-1)
        free = np.array([[geometry.has_room(x, y, BODY) for y in ys] for x in xs])
        self.places = grid[free]
        self.radius = radius
        number = np.full(free.shape, -1)
        number[free] = np.arange(free.sum())
        # Four directions; the other four are the ways back.
        pairs = [(number[1:, :], number[:-1, :]), (number[:, 1:], number[:, :-1])]
        pairs += [(number[1:, 1:], number[:-1, :-1]), (number[1:, :-1], number[:-1, 1:])]
        ends = np.concatenate([np.stack([a.ravel(), b.ravel()]) for a, b in pairs], axis=1)
        ends = ends[:, (ends >= 0).all(axis=0)]
        n = len(self.places)
        self.moves = coo_array((np.ones(ends.shape[1]), (ends[0], ends[1])), shape=(n, n)).tocsr()

    def __call__(self, start: NDArray[np.float64], goal: NDArray[np.float64]) -> int:
        """Return the number of moves.

        :param start: shape (2,)
        :param goal: shape (2,)
        """
        here = int(np.linalg.norm(self.places - start, axis=1).argmin())
        there = np.linalg.norm(self.places - goal, axis=1) <= self.radius
        n_moves = dijkstra(self.moves, directed=False, unweighted=True, indices=here)[there].min()
        if n_moves == np.inf:
            raise ValueError("No way leads there.")
        return int(n_moves)
