"""The point and the ant of gymnasium-robotics in mazes, as tasks with a free choice of start and goal."""

import contextlib
import io
import math
import tempfile
import threading
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any

import mujoco
import numpy as np
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.utils import EzPickle
from numpy.typing import NDArray

from sb3_skillgraph.envs.maze_geometry import MazeGeometry, MazeMap
from sb3_skillgraph.envs.task import GoalTask, Observation
from sb3_skillgraph.envs.wrappers import lies_down

# gymnasium-robotics prints a notice about its hand tasks to stderr when it is imported.
with contextlib.redirect_stderr(io.StringIO()):
    from gymnasium_robotics.envs.maze import ant_maze_v5, point_maze

_POINT_CELL_SIZE, _ANT_CELL_SIZE = 1.0, 4.0
_FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
_temporary_directory_lock = threading.Lock()


@contextlib.contextmanager
def private_temporary_directory() -> Iterator[None]:
    """Make the temporary files of the block vanish at its end.

    gymnasium-robotics 1.4.2 writes the model to a file named after the clock and leaves it there. In a directory of its
    own no other process can write to the same name, and nothing stays behind whatever it is called.
    """
    with _temporary_directory_lock, tempfile.TemporaryDirectory(prefix="skillgraph_") as directory:
        before, tempfile.tempdir = tempfile.tempdir, directory
        try:
            yield
        finally:
            tempfile.tempdir = before


class MujocoMazeTask(GoalTask, EzPickle):
    """What the MuJoCo mazes share; comes before a maze environment of gymnasium-robotics in the list of bases."""

    #: Moves the mark of the goal in the model.
    update_target_site_pos: Callable[[], None]

    @property
    @abstractmethod
    def _simulator(self) -> MujocoEnv:
        """The environment of the body alone, which holds model and data."""

    def _place(self, start: NDArray[np.float64]) -> None:
        self.update_target_site_pos()
        self._simulator.init_qpos[:2] = start
        self._simulator.reset()

    def _advance(self, action: NDArray[np.float32]) -> None:
        self._simulator.step(action)

    def _get_body_state(self) -> NDArray[np.float64]:
        model = self._simulator.model
        state = np.empty(mujoco.mj_stateSize(model, _FULL_STATE))
        mujoco.mj_getState(model, self._simulator.data, state, _FULL_STATE)
        return state

    def _set_body_state(self, state: NDArray[np.float64]) -> None:
        self.update_target_site_pos()
        model, data = self._simulator.model, self._simulator.data
        mujoco.mj_setState(model, data, state, _FULL_STATE)
        mujoco.mj_forward(model, data)  # for what is derived from the state, such as what a renderer shows
        mujoco.mj_setState(model, data, state, _FULL_STATE)  # before 3.3.6 mj_forward changes the warm start

    def __getstate__(self) -> dict[str, Any]:
        return {**EzPickle.__getstate__(self), "task_state": self.get_state()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        EzPickle.__setstate__(self, state)
        self.set_state(state["task_state"])


class PointMazeEnv(MujocoMazeTask, point_maze.PointMazeEnv):
    """A ball pushed by forces in a maze of cells of 1 m.

    Body, model and spaces are those of gymnasium-robotics' ``PointMaze-v3``: the observation is (x, y, vx, vy), the
    action the force on both axes, a step 0.01 s.

    :param maze_map: rows of cells, see :class:`~sb3_skillgraph.envs.maze_geometry.MazeGeometry`; required
    :param render_mode: None or one of ``metadata["render_modes"]``
    :param success_radius: distance to the goal that counts as success, in metres
    :param max_steps: steps after which an episode is truncated
    :param terminate_on_success: whether reaching the goal ends the episode
    :raises ValueError: when an argument is unusable
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as Gymnasium has it)
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 100,
    }
    option_view = "egocentric"
    body_radius = 0.1
    # Contacts are soft: the ball is this near to a wall when it hits it at full speed, and may start there.
    start_margin = 0.03

    def __init__(
        self,
        maze_map: MazeMap | None = None,
        render_mode: str | None = None,
        success_radius: float = 0.45,
        max_steps: int = 1000,
        terminate_on_success: bool = False,
    ) -> None:
        geometry = make_geometry(maze_map, _POINT_CELL_SIZE)
        with private_temporary_directory():
            super().__init__(maze_map=geometry.maze_map, render_mode=render_mode)
        self._init_task(geometry, success_radius, max_steps, terminate_on_success)
        EzPickle.__init__(self, maze_map, render_mode, success_radius, max_steps, terminate_on_success)

    @property
    def _simulator(self) -> MujocoEnv:
        return self.point_env

    def _observe(self) -> Observation:
        return self._get_obs(self.point_env._get_obs()[0])


class AntMazeEnv(MujocoMazeTask, ant_maze_v5.AntMazeEnv):
    """The four-legged ant in a maze of cells of 4 m.

    Body and model are those of gymnasium-robotics' ``AntMaze-v5`` without contact forces: the observation has 27
    numbers (height, orientation as a quaternion, 8 joint angles, the torso's velocities, joint velocities) and leaves
    out x and y, which are the achieved goal. ``info["stuck"]`` is there, and True, once it has fallen on its back, from
    where it cannot get up.

    Torque and control period are those of D4RL's ant; ``AntMaze-v5`` has 150 and 5. With motors that strong random actions
    throw the ant on its back within seconds.

    :param maze_map: rows of cells, see :class:`~sb3_skillgraph.envs.maze_geometry.MazeGeometry`; required
    :param render_mode: None or one of ``metadata["render_modes"]``
    :param success_radius: distance to the goal that counts as success, in metres
    :param max_steps: steps after which an episode is truncated
    :param terminate_on_success: whether reaching the goal ends the episode
    :param torque: that an action of 1 means, the simulator's units
    :param frame_skip: simulator steps of 0.01 s that an action is held for; an environment step
    :param tell_stuck: whether ``info`` says so when the ant has fallen on its back; otherwise it lies there
    :raises ValueError: when an argument is unusable
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 (as Gymnasium has it)
        "render_modes": ["human", "rgb_array", "depth_array"],
        "render_fps": 10,
    }
    option_view = "placed_body"
    # The ant is always reset facing along x, its feet 0.88 m away from the centre on both axes.
    body_radius = 0.9
    start_margin = 0.9

    def __init__(
        self,
        maze_map: MazeMap | None = None,
        render_mode: str | None = None,
        success_radius: float = 0.45,
        max_steps: int = 1000,
        terminate_on_success: bool = False,
        torque: float = 30.0,
        frame_skip: int = 10,
        tell_stuck: bool = True,
    ) -> None:
        geometry = make_geometry(maze_map, _ANT_CELL_SIZE)
        if not (math.isfinite(torque) and torque > 0):
            raise ValueError(f"torque must be a positive number, not {torque!r}")
        if not isinstance(frame_skip, int | np.integer) or frame_skip < 1:
            raise ValueError(f"frame_skip must be a whole number of simulator steps, at least 1, not {frame_skip!r}")
        with private_temporary_directory():
            super().__init__(
                maze_map=geometry.maze_map,
                render_mode=render_mode,
                frame_skip=frame_skip,
                include_cfrc_ext_in_observation=False,
            )
        self.model.actuator_gear[:, 0] = torque
        self._look_at(geometry)
        self._init_task(geometry, success_radius, max_steps, terminate_on_success)
        self.metadata = {**self.metadata, "render_fps": round(1.0 / self.ant_env.dt)}
        self.tell_stuck = tell_stuck
        EzPickle.__init__(
            self, maze_map, render_mode, success_radius, max_steps, terminate_on_success, torque, frame_skip, tell_stuck
        )

    def _look_at(self, geometry: MazeGeometry) -> None:
        """Let pictures show the whole maze: gymnasium-robotics' stand where the ant is not."""
        renderer = self.ant_env.mujoco_renderer
        left, right, bottom, top = geometry.extent
        middle = np.array([(left + right) / 2, (bottom + top) / 2, 0.0])
        # A free camera, which is what -1 means there.
        renderer.camera_id = -1
        renderer.default_cam_config = {
            "lookat": middle,
            "distance": 1.05 * max(right - left, top - bottom),
            "azimuth": 90.0,
            "elevation": -65.0,
        }

    @property
    def _simulator(self) -> MujocoEnv:
        return self.ant_env

    def _observe(self) -> Observation:
        return self._get_obs(self.ant_env._get_obs())

    def _is_stuck(self) -> bool:
        return self.tell_stuck and lies_down(self.ant_env.data.qpos[3:7])


def make_geometry(maze_map: MazeMap | None, cell_size: float) -> MazeGeometry:
    """Return the geometry of a maze.

    :param maze_map: rows of cells; None says what is missing
    :param cell_size: side of a cell, in metres
    :raises ValueError: when the map is missing or unusable
    """
    if maze_map is None:
        raise ValueError(
            "maze_map is required, for example maze_map=[[1, 1, 1, 1], [1, 'r', 0, 1], [1, 1, 1, 1]] "
            "(on the command line in quotes, after --env-kwargs)"
        )
    return MazeGeometry(maze_map, cell_size)
