"""Geometry of grid mazes: free space, uniform samples, shortest paths. NumPy and SciPy only, no simulator."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

MazeMap = Sequence[Sequence[int | str]]

#: Mazes of gymnasium-robotics (its ``U_MAZE``, ``MEDIUM_MAZE``, ``LARGE_MAZE``), repeated here because importing them
#: from there loads MuJoCo.
U_MAZE: MazeMap = [
    [1, 1, 1, 1, 1],
    [1, 0, 0, 0, 1],
    [1, 1, 1, 0, 1],
    [1, 0, 0, 0, 1],
    [1, 1, 1, 1, 1],
]
MEDIUM_MAZE: MazeMap = [
    [1, 1, 1, 1, 1, 1, 1, 1],
    [1, 0, 0, 1, 1, 0, 0, 1],
    [1, 0, 0, 1, 0, 0, 0, 1],
    [1, 1, 0, 0, 0, 1, 1, 1],
    [1, 0, 0, 1, 0, 0, 0, 1],
    [1, 0, 1, 0, 0, 1, 0, 1],
    [1, 0, 0, 0, 1, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1, 1],
]
LARGE_MAZE: MazeMap = [
    [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
    [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 1],
    [1, 0, 1, 1, 0, 1, 0, 1, 0, 1, 0, 1],
    [1, 0, 0, 0, 0, 0, 0, 1, 0, 0, 0, 1],
    [1, 0, 1, 1, 1, 1, 0, 1, 1, 1, 0, 1],
    [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 0, 1],
    [1, 1, 0, 1, 0, 1, 0, 1, 0, 1, 1, 1],
    [1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1],
]
#: Five by five free cells, the start in the middle: with cells of 4 m the free area is [-10, 10] x [-10, 10].
OPEN_AREA: MazeMap = [
    [1, 1, 1, 1, 1, 1, 1],
    [1, 0, 0, 0, 0, 0, 1],
    [1, 0, 0, 0, 0, 0, 1],
    [1, 0, 0, "r", 0, 0, 1],
    [1, 0, 0, 0, 0, 0, 1],
    [1, 0, 0, 0, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1],
]

_WALL = 1
_ENTRIES = (0, 1, "r", "g", "c")
_MAX_REJECTIONS = 100_000
# Share of a cell.
_HAIR = 1e-6


def _validated(maze_map: MazeMap) -> list[list[int | str]]:
    """Check a maze map.

    :param maze_map: rows of cells
    :return: the map as a list of lists
    :raises ValueError: when it is no closed rectangle of known entries with a free cell
    """
    rows = [list(row) for row in maze_map]
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError(f"a maze map must be a rectangle: its rows have lengths {[len(row) for row in rows]}")
    unknown = {repr(cell) for row in rows for cell in row if cell not in _ENTRIES}
    if unknown:
        raise ValueError(f"a maze map holds {sorted(unknown)}: each entry must be one of {list(_ENTRIES)}")
    border = [*rows[0], *rows[-1], *(row[0] for row in rows), *(row[-1] for row in rows)]
    if any(cell != _WALL for cell in border):
        raise ValueError("a maze map must be closed: every cell of its border must be a wall (1)")
    if all(cell == _WALL for row in rows for cell in row):
        raise ValueError("a maze map must have at least one free cell (an entry other than 1)")
    return rows


class MazeGeometry:
    """The plane geometry of a maze of square cells.

    Positions follow gymnasium-robotics: the origin is the centre of the map, row 0 is at the top (largest y).
    ``extent`` is the rectangle of the map, walls included: (x min, x max, y min, y max).

    :param maze_map: rows of cells: ``1`` is a wall, ``0``, ``"r"`` (start), ``"g"`` and ``"c"`` are free; the border
        must be walls
    :param cell_size: side of a cell, in world units
    :param center: where the centre of the map lies, (x, y)
    :raises ValueError: when the map or the cell size is unusable
    """

    def __init__(self, maze_map: MazeMap, cell_size: float = 1.0, center: tuple[float, float] = (0.0, 0.0)) -> None:
        if not (math.isfinite(cell_size) and cell_size > 0):
            raise ValueError(f"cell_size must be a positive number, not {cell_size!r}")
        self.maze_map = _validated(maze_map)
        self.cell_size = float(cell_size)
        self._is_wall = [[cell == _WALL for cell in row] for row in self.maze_map]
        half_width, half_height = len(self.maze_map[0]) * self.cell_size / 2, len(self.maze_map) * self.cell_size / 2
        self.extent = center[0] - half_width, center[0] + half_width, center[1] - half_height, center[1] + half_height
        self._left, self._top = self.extent[0], self.extent[3]
        self.free_cells = [(i, j) for i, row in enumerate(self._is_wall) for j, is_wall in enumerate(row) if not is_wall]
        self._corner_graphs: dict[float, _CornerGraph] = {}

    @property
    def start_cell(self) -> tuple[int, int]:
        """The cell where episodes start: the map's first ``"r"`` cell, else its first free cell, in reading order.

        :return: (row, column)
        """
        return next((cell for cell in self.free_cells if self.maze_map[cell[0]][cell[1]] == "r"), self.free_cells[0])

    def cell_to_xy(self, row: int, column: int) -> NDArray[np.float64]:
        """Centre of a cell.

        :param row: row of the cell, 0 at the top
        :param column: column of the cell, 0 at the left
        :return: position, shape (2,)
        """
        x = (column + 0.5) * self.cell_size + self._left
        y = self._top - (row + 0.5) * self.cell_size
        return np.array([x, y])

    def walls(self) -> list[tuple[float, float, float, float]]:
        """Rectangles of the wall cells, as a plot takes them.

        :return: one (x, y, width, height) per wall cell; x, y is the lower left corner
        """
        size = self.cell_size
        return [
            (j * size + self._left, self._top - (i + 1) * size, size, size)
            for i, row in enumerate(self._is_wall)
            for j, is_wall in enumerate(row)
            if is_wall
        ]

    def has_room(self, x: float, y: float, margin: float = 0.0) -> bool:
        """Whether a disc lies in free space; one point, without the cost of an array.

        :param x: x of its centre
        :param y: y of its centre
        :param margin: its radius
        :return: True when it is inside the map and touches no wall
        """
        column, row, reach = self._in_cells(x, y, margin)
        n_rows, n_columns = len(self._is_wall), len(self._is_wall[0])
        if not (0 < column < n_columns and 0 < row < n_rows):
            return False
        # Closed cells: a disc that only touches the edge of a cell counts as in it.
        columns = range(max(math.ceil(column - reach) - 1, 0), min(math.floor(column + reach) + 1, n_columns))
        for i in range(max(math.ceil(row - reach) - 1, 0), min(math.floor(row + reach) + 1, n_rows)):
            dy = max(i - row, 0.0, row - i - 1)
            for j in columns:
                if self._is_wall[i][j]:
                    dx = max(j - column, 0.0, column - j - 1)
                    if dx * dx + dy * dy <= reach * reach:
                        return False
        return True

    def _in_cells(self, x: float, y: float, margin: float) -> tuple[float, float, float]:
        size = self.cell_size
        return (x - self._left) / size, (self._top - y) / size, margin / size

    def is_free(self, points: ArrayLike, margin: float = 0.0) -> NDArray[np.bool_]:
        """Which discs lie in free space.

        :param points: their centres, shape (n, 2), in world units
        :param margin: their radius, in world units
        :return: True for the discs that are inside the map and touch no wall, shape (n,)
        """
        array = np.asarray(points, dtype=np.float64).reshape(-1, 2)
        return np.array([self.has_room(x, y, margin) for x, y in array.tolist()], dtype=bool)

    def sample_free(self, rng: np.random.Generator, margin: float = 0.0) -> NDArray[np.float64]:
        """Draw a position uniformly over the free area.

        :param rng: source of randomness
        :param margin: least distance from a wall, in world units
        :return: position, shape (2,)
        :raises ValueError: when no free area is left at this margin
        """
        for _ in range(_MAX_REJECTIONS):
            # All free cells have the same area, so that a uniform cell and a uniform point in it are uniform over the
            # free cells; rejection keeps that so within the margin.
            row, column = self.free_cells[rng.integers(len(self.free_cells))]
            point = self.cell_to_xy(row, column) + self.cell_size * rng.uniform(-0.5, 0.5, size=2)
            if self.has_room(float(point[0]), float(point[1]), margin):
                return point
        raise ValueError(f"no free area is left {margin} away from the walls of cells of size {self.cell_size}")

    def shortest_path_length(self, a: ArrayLike, b: ArrayLike, margin: float = 0.0) -> float:
        """Length of the shortest way for a disc between two positions.

        Exact at margin 0. Otherwise the rounding of the way around corners is cut, which makes a way with many corners
        a few percent too short. The distances between the corners of the maze are computed once per margin.

        :param a: one end, shape (2,)
        :param b: other end, shape (2,)
        :param margin: radius of the disc, less than half a cell
        :return: length in world units, infinite when there is no way or an end lies in a wall
        :raises ValueError: when the disc is too wide for a corridor of one cell
        """
        path = self.shortest_path(a, b, margin)
        return math.inf if path is None else float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())

    def shortest_path(self, a: ArrayLike, b: ArrayLike, margin: float = 0.0) -> NDArray[np.float64] | None:
        """Shortest way for a disc between two positions; what is said of its length holds for it, too.

        :param a: one end, shape (2,)
        :param b: other end, shape (2,)
        :param margin: radius of the disc, less than half a cell
        :return: the ends and the corners in between, shape (n, 2); None when there is no way or an end lies in a wall
        :raises ValueError: when the disc is too wide for a corridor of one cell
        """
        if not 0 <= margin < self.cell_size / 2:
            raise ValueError(f"margin must be at least 0 and less than half the cell size, not {margin!r}")
        start, end = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
        if not self.is_free([start, end]).all():
            return None
        if margin not in self._corner_graphs:
            self._corner_graphs[margin] = _CornerGraph(self._is_wall, self.extent, self.cell_size, margin)
        return self._corner_graphs[margin].path(start, end)


class _CornerGraph:
    """Visibility graph over the corners of a maze: the shortest way bends at corners only.

    Walls are widened by margin / sqrt(2), so that their corners are at distance margin from those of the maze, and made
    narrower by a hair, so that a way along a wall does not cross it.

    :param is_wall: rows of cells
    :param extent: (x min, x max, y min, y max) of the map
    :param cell_size: side of a cell
    :param margin: distance that corners of the way keep from corners of the maze
    """

    def __init__(
        self, is_wall: list[list[bool]], extent: tuple[float, float, float, float], cell_size: float, margin: float
    ) -> None:
        from scipy.sparse.csgraph import shortest_path  # when it is used: it takes a while to import

        walls = np.array(is_wall)
        hair, width = _HAIR * cell_size, margin / math.sqrt(2)
        self._origin = np.array([extent[0], extent[3]])
        self._scale = np.array([cell_size, -cell_size])
        corners, outward, gaps = _find_corners(walls)
        self._corners = self._to_xy(corners) + outward * [width, -width]
        # Runs of cells in both directions leave no slit between neighbours. Where two walls meet at a corner only, a
        # patch closes the hole that the hair would open.
        first, last = _find_runs(walls)
        blocks = np.stack([self._to_xy(first), self._to_xy(last)], axis=1)
        patches = np.repeat(self._to_xy(gaps)[:, None], 2, axis=1)
        grown = [(blocks, width - hair), (patches, width + hair)]
        self._low = np.concatenate([box.min(axis=1) - by for box, by in grown])
        self._high = np.concatenate([box.max(axis=1) + by for box, by in grown])
        lengths = np.array([self._visible_distances(corner) for corner in self._corners]).reshape(2 * (len(corners),))
        lengths = np.where(np.isfinite(lengths), lengths, 0.0)
        self._between, self._before = shortest_path(lengths, directed=False, return_predecessors=True)

    def _to_xy(self, column_row: NDArray[np.int64]) -> NDArray[np.float64]:
        return self._origin + self._scale * column_row

    def _visible_distances(self, point: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances to the corners that can be reached in a straight line.

        :param point: position, shape (2,)
        :return: distances, infinite where a wall is in between, shape (number of corners,)
        """
        distances = np.linalg.norm(self._corners - point, axis=1)
        return np.where(self._are_visible(point, self._corners), distances, math.inf)

    def _are_visible(self, point: NDArray[np.float64], targets: NDArray[np.float64]) -> NDArray[np.bool_]:
        # The share of the segment at which it enters and leaves the two slabs whose intersection is a box.
        direction = (targets - point)[:, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (self._low - point) / direction, (self._high - point) / direction
        # Parallel to a slab the division gives infinities of the right signs; on its very edge it gives a NaN, which
        # counts as outside.
        enter, leave = np.fmin(one, other).max(axis=2), np.fmax(one, other).min(axis=2)
        return ~(np.maximum(enter, 0.0) < np.minimum(leave, 1.0)).any(axis=1)

    def path(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64] | None:
        """Shortest way.

        :param a: one end, shape (2,)
        :param b: other end, shape (2,)
        :return: the ends and the corners in between, shape (n, 2); None when there is no way
        """
        if self._are_visible(a, b[None])[0]:
            return np.stack([a, b])
        ways = self._visible_distances(a)[:, None] + self._between + self._visible_distances(b)
        if not np.isfinite(ways.min(initial=math.inf)):
            return None
        first, corner = np.unravel_index(ways.argmin(), ways.shape)
        corners = [corner]
        while corners[-1] != first:
            corners.append(self._before[first, corners[-1]])
        return np.concatenate([a[None], self._corners[corners[::-1]], b[None]])


def _find_corners(walls: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Find where ways can bend: at the convex corners of walls.

    :param walls: which cells are walls, shape (rows, columns)
    :return: corners as (column, row) of grid lines, shape (n, 2); for each the direction away from its wall as
        (column, row) signs, shape (n, 2); the points where two walls meet at a corner only, shape (m, 2)
    """
    corners, outward, gaps = [], [], []
    for i, j in np.ndindex(walls.shape[0] - 1, walls.shape[1] - 1):
        block = walls[i : i + 2, j : j + 2]
        if block.sum() == 1:
            wall_row, wall_column = np.argwhere(block)[0]
            corners.append((j + 1, i + 1))
            outward.append((1 - 2 * wall_column, 1 - 2 * wall_row))
        elif block.sum() == 2 and block[0, 0] == block[1, 1]:
            gaps.append((j + 1, i + 1))
    as_pairs = (np.array(pairs, dtype=np.int64).reshape(-1, 2) for pairs in (corners, outward, gaps))
    return next(as_pairs), next(as_pairs), next(as_pairs)


def _find_runs(walls: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Find the longest runs of wall cells, along rows and along columns.

    :param walls: which cells are walls, shape (rows, columns)
    :return: opposite corners of the runs as (column, row) of grid lines, two arrays of shape (n, 2)
    """
    first, last = [], []
    for grid, flip in ((walls, False), (walls.T, True)):
        edges = np.diff(np.pad(grid, ((0, 0), (1, 1))).astype(np.int64), axis=1)
        for (line, begin), (_, end) in zip(np.argwhere(edges == 1), np.argwhere(edges == -1), strict=True):
            corners = ((begin, line), (end, line + 1))
            first.append(corners[0][::-1] if flip else corners[0])
            last.append(corners[1][::-1] if flip else corners[1])
    return np.array(first, dtype=np.int64), np.array(last, dtype=np.int64)
