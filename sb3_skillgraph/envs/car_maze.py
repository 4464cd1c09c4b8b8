"""The point robot of Nachum et al. (2018), which the paper's point mazes are driven by (section A.4)."""

from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from sb3_skillgraph.envs.maze_geometry import MazeMap
from sb3_skillgraph.envs.mujoco_mazes import MujocoMazeTask, make_geometry, private_temporary_directory
from sb3_skillgraph.envs.task import Observation

# isort: split
from gymnasium_robotics.envs.maze import maze_v4  # after the module that keeps its import quiet

_CELL_SIZE = 3.0
_MAX_STEP = 1.0  # metres
_MAX_TURN = 0.25  # radians
_MODEL = Path(__file__).parent / "assets" / "car.xml"


class CarEnv(MujocoEnv):
    """The car alone: it turns, then moves along its heading; where that would hit something, it only turns.

    :param xml_file: model of car and maze
    :param render_mode: None or one of ``metadata["render_modes"]``
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as Gymnasium has it)
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 20,
    }

    def __init__(self, xml_file: str, render_mode: str | None = None) -> None:
        space = spaces.Box(-np.inf, np.inf, (6,), np.float64)
        camera = {"distance": 40.0, "elevation": -90.0}
        super().__init__(xml_file, 1, space, render_mode=render_mode, default_camera_config=camera)

    def step(self, action: NDArray[np.float32]) -> tuple[NDArray[np.float64], np.float64, bool, bool, dict[str, np.float64]]:
        """Turn and move.

        :param action: share of the largest step and of the largest turn
        :return: observation, no reward, never the end
        """
        before = self.data.qpos.copy()
        drive, turn = np.clip(action, -1.0, 1.0).tolist()
        after = before.copy()
        after[2] = np.mod(before[2] + _MAX_TURN * turn + np.pi, 2 * np.pi) - np.pi
        after[:2] += _MAX_STEP * drive * np.array([np.cos(after[2]), np.sin(after[2])])
        velocity = np.array([*(after[:2] - before[:2]), _MAX_TURN * turn]) / self.dt
        self.set_state(after, velocity)
        if self.data.ncon:
            self.set_state(np.array([*before[:2], after[2]]), np.array([0.0, 0.0, velocity[2]]))
        if self.render_mode == "human":
            self.render()
        return self.observe(), np.float64(0.0), False, False, {}

    def reset_model(self) -> NDArray[np.float64]:
        """Put the car at rest where ``init_qpos`` says."""
        self.set_state(self.init_qpos, self.init_qvel)
        return self.observe()

    def observe(self) -> NDArray[np.float64]:
        """Return position, heading and velocities, shape (6,)."""
        return np.concatenate([self.data.qpos, self.data.qvel])


class CarMazeEnv(MujocoMazeTask, maze_v4.MazeEnv):
    """A car that drives and turns in a maze of cells of 3 m.

    The observation is (x, y, heading, and their velocities), the heading in [-pi, pi]. An action in [-1, 1]^2 drives up
    to 1 m forward or backward and turns by up to 0.25 rad, at once, as in the environments of Nachum et al. (2018); a
    step of 0.05 s into a wall does not move the car. Episodes begin facing along x.

    :param maze_map: rows of cells, see :class:`~sb3_skillgraph.envs.maze_geometry.MazeGeometry`; required
    :param render_mode: None or one of ``metadata["render_modes"]``
    :param success_radius: distance to the goal that counts as success, in metres; the paper's
    :param max_steps: steps after which an episode is truncated
    :param terminate_on_success: whether reaching the goal ends the episode
    :raises ValueError: when an argument is unusable
    """

    metadata = CarEnv.metadata
    option_view = "egocentric"
    body_radius = 0.41
    start_margin = 0.4

    def __init__(
        self,
        maze_map: MazeMap | None = None,
        render_mode: str | None = None,
        success_radius: float = 0.6,
        max_steps: int = 1000,
        terminate_on_success: bool = False,
    ) -> None:
        geometry = make_geometry(maze_map, _CELL_SIZE)
        with private_temporary_directory():
            super().__init__(str(_MODEL), maze_map=geometry.maze_map, maze_size_scaling=_CELL_SIZE, maze_height=0.4)
            self.car_env = CarEnv(self.tmp_xml_file_path, render_mode)
        self.render_mode = render_mode
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)
        position = spaces.Box(-np.inf, np.inf, (2,), np.float64)
        self.observation_space = spaces.Dict(
            {"observation": self.car_env.observation_space, "achieved_goal": position, "desired_goal": position}
        )
        self._target = self.car_env.model.site("target").id
        self._init_task(geometry, success_radius, max_steps, terminate_on_success)
        EzPickle.__init__(self, maze_map, render_mode, success_radius, max_steps, terminate_on_success)

    @property
    def _simulator(self) -> MujocoEnv:
        return self.car_env

    @property
    def model(self) -> Any:
        """MuJoCo's model."""
        return self.car_env.model

    @property
    def data(self) -> Any:
        """MuJoCo's data."""
        return self.car_env.data

    def update_target_site_pos(self) -> None:
        """Move the mark of the goal."""
        self.car_env.model.site_pos[self._target, :2] = self.goal

    def _observe(self) -> Observation:
        observation = self.car_env.observe()
        return {"observation": observation, "achieved_goal": observation[:2].copy(), "desired_goal": self.goal.copy()}

    def render(self) -> Any:
        """Return a picture, or show one."""
        return self.car_env.render()

    def close(self) -> None:
        """Close the window."""
        self.car_env.close()
