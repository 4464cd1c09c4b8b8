"""A maze in which where one is is not all: a key has to be fetched before a door opens."""

from collections import deque
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from sb3_skillgraph.envs.maze_geometry import MazeGeometry, MazeMap
from sb3_skillgraph.envs.mujoco_mazes import PointMazeEnv
from sb3_skillgraph.envs.task import Observation
from sb3_skillgraph.metric import Exact, Product, Within

#: ``"k"`` is where the key lies, ``"d"`` the door.
KEY_DOOR_MAZE: MazeMap = [
    [1, 1, 1, 1, 1, 1, 1, 1, 1],
    [1, "k", 0, 0, 1, 0, 0, 0, 1],
    [1, 1, 1, 0, 1, 0, 1, 0, 1],
    [1, 0, 0, 0, "d", 0, 1, 0, 1],
    [1, 0, 1, 1, 1, 0, 1, 0, 1],
    [1, "r", 0, 0, 1, 0, 0, 0, 1],
    [1, 1, 1, 1, 1, 1, 1, 1, 1],
]
_KEY, _DOOR = 2, 3  # dimensions of a goal
#: Metres from the middle of the key's cell within which the key is taken: the ball has a radius of 0.1 m.
_TAKEN = 0.3
#: Metres from the door within which who has the key opens it.
_OPENED = 0.25


class PointKeyDoorEnv(PointMazeEnv):
    """The ball of :class:`~sb3_skillgraph.envs.mujoco_mazes.PointMazeEnv` in a maze with a key and a door.

    A goal is (x, y, key, door): where to be, whether with the key (0 or 1) and whether with the door open. The key is taken by
    coming near, the door opens to who comes near with the key; neither can be undone. The observation is the achieved goal and
    the velocity. Goals are drawn from what can be achieved: uniformly over free space, and on this side of the door from
    (0, 0), (1, 0) and (1, 1).

    :param maze_map: rows of cells, one ``"k"`` and one ``"d"`` among them
    :param render_mode: None or one of ``metadata["render_modes"]``
    :param success_radius: distance to the goal that counts as success, in metres, where key and door are as wanted
    :param max_steps: steps after which an episode is truncated
    :param terminate_on_success: whether reaching the goal ends the episode
    :raises ValueError: when an argument is unusable
    """

    def __init__(
        self,
        maze_map: MazeMap = KEY_DOOR_MAZE,
        render_mode: str | None = None,
        success_radius: float = 0.45,
        max_steps: int = 1000,
        terminate_on_success: bool = False,
    ) -> None:
        key, door = _cell_of("k", maze_map), _cell_of("d", maze_map)
        self._flags = np.zeros(2)  # key, door
        self.goal_metric = Product(Within((0, 1), success_radius), Exact((_KEY, _DOOR)))
        super().__init__(_with(maze_map, d=1, k=0), render_mode, success_radius, max_steps, terminate_on_success)
        self.geometry = MazeGeometry(_with(maze_map, d=0, k=0))  # of the open door
        self._key_at, self._door_at = self.geometry.cell_to_xy(*key), self.geometry.cell_to_xy(*door)
        self._near = _connected(MazeGeometry(_with(maze_map, d=1, k=0)))
        self._door = self.point_env.model.geom(f"block_{door[0]}_{door[1]}").id
        self.goal = np.array([*self.goal, 0.0, 0.0])
        position = spaces.Box(-np.inf, np.inf, (4,), np.float64)
        observation = spaces.Box(-np.inf, np.inf, (6,), np.float64)
        self.observation_space = spaces.Dict(observation=observation, achieved_goal=position, desired_goal=position)
        EzPickle.__init__(self, maze_map, render_mode, success_radius, max_steps, terminate_on_success)

    # -- key and door -------------------------------------------------------------------------------------------------

    def _set_flags(self, flags: NDArray[np.float64]) -> None:
        """Have the key, or not; open the door, or close it."""
        self._flags = np.array(flags, dtype=np.float64)
        model, is_open = self.point_env.model, bool(self._flags[1])
        model.geom_contype[self._door] = model.geom_conaffinity[self._door] = int(not is_open)
        model.geom_rgba[self._door, 3] = 0.1 if is_open else 1.0

    def _advance(self, action: NDArray[np.float32]) -> None:
        super()._advance(action)
        has_key, is_open = (bool(flag) for flag in self._flags)
        if is_open:
            return
        point = self.point_env.data.qpos
        takes_key = bool(np.linalg.norm(point - self._key_at) <= _TAKEN)
        outside = np.maximum(np.abs(point - self._door_at) - 0.5 * self.geometry.cell_size, 0.0)
        opens = has_key and bool(np.linalg.norm(outside) <= _OPENED)
        if opens or (takes_key and not has_key):
            self._set_flags(np.array([1.0, float(opens)]))

    def _place(self, start: NDArray[np.float64]) -> None:
        self._set_flags(start[2:] if len(start) > 2 else np.zeros(2))
        super()._place(start[:2])

    def update_target_site_pos(self) -> None:
        """Move the mark of the goal to where it is."""
        goal, self.goal = self.goal, self.goal[:2]
        super().update_target_site_pos()
        self.goal = goal

    def _observe(self) -> Observation:
        x, y, *velocity = self.point_env._get_obs()[0]
        achieved = np.array([x, y, *self._flags])
        return {
            "observation": np.array([*achieved, *velocity]),
            "achieved_goal": achieved,
            "desired_goal": self.goal.copy(),
        }

    # -- goals --------------------------------------------------------------------------------------------------------

    def sample_free(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a goal that can be achieved.

        :param rng: source of randomness
        :return: shape (4,)
        """
        place = super().sample_free(rng)
        flags = ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))[rng.integers(3)]
        return np.array([*place, *(flags if self._is_near(place) else (1.0, 1.0))])

    def _is_near(self, place: NDArray[np.float64]) -> bool:
        """Tell whether a place lies on this side of the door."""
        left, _, _, top = self.geometry.extent
        column, row = int((place[0] - left) // self.geometry.cell_size), int((top - place[1]) // self.geometry.cell_size)
        return (row, column) in self._near

    def _check_position(self, name: str, value: Any, margin: float) -> NDArray[np.float64]:
        numbers = np.ravel(np.asarray(value, dtype=object))
        flags = tuple(numbers[2:]) or (0.0, 0.0)
        wrong = len(numbers) not in ((4,) if name == "goal" else (2, 4)) or flags not in ((0, 0), (1, 0), (1, 1))
        place = None if wrong else super()._check_position(name, list(numbers[:2]), margin)
        if place is None or (flags != (1, 1) and not self._is_near(place)):
            raise ValueError(
                f"reset option {name!r} is {value!r}: it must be (x, y, key, door) with key and door 0 or 1, no open door "
                "without the key, and nothing behind a door that is shut (a start may be (x, y) alone)"
            )
        return np.array([*place, *map(float, flags)])

    def _is_at_goal(self, observation: Observation) -> bool:
        return self.goal_metric.reached(observation["achieved_goal"], self.goal)

    def _are_near(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_] | np.bool_:
        return self.goal_metric.distance(a, b) <= 1.0

    # -- saving -------------------------------------------------------------------------------------------------------

    def _get_body_state(self) -> NDArray[np.float64]:
        return np.concatenate([super()._get_body_state(), self._flags])

    def _set_body_state(self, state: NDArray[np.float64]) -> None:
        self._set_flags(state[-2:])
        super()._set_body_state(state[:-2])


def _cell_of(mark: str, maze_map: MazeMap) -> tuple[int, int]:
    cells = [(i, j) for i, row in enumerate(maze_map) for j, cell in enumerate(row) if cell == mark]
    if len(cells) != 1:
        raise ValueError(f"a maze with key and door has one cell {mark!r}, not {len(cells)}")
    return cells[0]


def _with(maze_map: MazeMap, **marks: int) -> MazeMap:
    """Return a map with walls or free cells in place of marks."""
    return [[marks.get(cell, cell) if isinstance(cell, str) else cell for cell in row] for row in maze_map]


def _connected(geometry: MazeGeometry) -> set[tuple[int, int]]:
    """Return the free cells that can be reached from the start."""
    free, found = set(geometry.free_cells), {geometry.start_cell}
    ahead = deque(found)
    while ahead:
        i, j = ahead.popleft()
        for cell in ((i + 1, j), (i - 1, j), (i, j + 1), (i, j - 1)):
            if cell in free - found:
                found.add(cell)
                ahead.append(cell)
    return found
