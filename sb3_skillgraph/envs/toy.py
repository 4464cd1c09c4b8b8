"""A maze that needs no simulator, for tests and for trying things out."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_skillgraph.envs.maze_geometry import U_MAZE, MazeGeometry, MazeMap
from sb3_skillgraph.envs.task import GoalTask, Observation

_PIXELS_PER_CELL = 32
_FREE_COLOUR, _WALL_COLOUR = (255, 255, 255), (90, 90, 90)
_GOAL_COLOUR, _BODY_COLOUR = (230, 80, 60), (40, 90, 200)


class ToyMazeEnv(GoalTask):
    """A point that an action displaces in a maze of cells of side 1.

    Both axes move one after the other; an axis that would enter a wall stays where it is, so that the point slides
    along walls. The observation is the position.

    :param maze_map: rows of cells, see :class:`~sb3_skillgraph.envs.maze_geometry.MazeGeometry`
    :param render_mode: None or ``"rgb_array"``
    :param success_radius: distance to the goal that counts as success, in cells
    :param max_steps: steps after which an episode is truncated
    :param terminate_on_success: whether reaching the goal ends the episode
    :param step_size: displacement along an axis at action 1, in cells; at most 1
    :raises ValueError: when an argument is unusable
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (as Gymnasium has it)
    option_view = "relative"
    body_radius = 0.0
    start_margin = 0.0

    def __init__(
        self,
        maze_map: MazeMap = U_MAZE,
        render_mode: str | None = None,
        success_radius: float = 0.45,
        max_steps: int = 100,
        terminate_on_success: bool = False,
        step_size: float = 0.25,
    ) -> None:
        if not 0 < step_size <= 1:
            raise ValueError(f"step_size must be in (0, 1], lest a step jumps over a wall, not {step_size!r}")
        self.step_size = float(step_size)
        self.render_mode = render_mode
        position = spaces.Box(-np.inf, np.inf, shape=(2,), dtype=np.float64)
        self.observation_space = spaces.Dict({"observation": position, "achieved_goal": position, "desired_goal": position})
        self.action_space = spaces.Box(-1.0, 1.0, shape=(2,), dtype=np.float32)
        self._init_task(MazeGeometry(maze_map), success_radius, max_steps, terminate_on_success)
        self._place(self.goal)

    def _place(self, start: NDArray[np.float64]) -> None:
        self._x, self._y = start.tolist()

    def _advance(self, action: NDArray[np.float32]) -> None:
        dx, dy = (self.step_size * min(max(float(a), -1.0), 1.0) for a in action)
        if self.geometry.has_room(self._x + dx, self._y):
            self._x += dx
        if self.geometry.has_room(self._x, self._y + dy):
            self._y += dy

    def _observe(self) -> Observation:
        position = np.array([self._x, self._y])
        return {"observation": position, "achieved_goal": position.copy(), "desired_goal": self.goal.copy()}

    def _get_body_state(self) -> NDArray[np.float64]:
        return np.array([self._x, self._y])

    def _set_body_state(self, state: NDArray[np.float64]) -> None:
        self._place(state)

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the maze, the goal with its radius, and the point.

        :return: the image, shape (height, width, 3), or None without a render mode
        """
        if self.render_mode is None:
            return None
        is_wall = np.array([[cell == 1 for cell in row] for row in self.geometry.maze_map])
        is_wall = is_wall.repeat(_PIXELS_PER_CELL, axis=0).repeat(_PIXELS_PER_CELL, axis=1)
        image = np.where(is_wall[..., None], _WALL_COLOUR, _FREE_COLOUR).astype(np.uint8)
        x_min, _, _, y_max = self.geometry.extent
        xs = x_min + (np.arange(image.shape[1]) + 0.5) / _PIXELS_PER_CELL
        ys = y_max - (np.arange(image.shape[0]) + 0.5) / _PIXELS_PER_CELL
        discs = (
            (float(self.goal[0]), float(self.goal[1]), self.success_radius, _GOAL_COLOUR),
            (self._x, self._y, 0.1, _BODY_COLOUR),
        )
        for x, y, radius, colour in discs:
            image[(xs[None] - x) ** 2 + (ys[:, None] - y) ** 2 <= radius**2] = colour
        return image
