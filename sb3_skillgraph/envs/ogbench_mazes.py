"""The mazes of OGBench (Park et al., 2025) as goal environments; needs the extra ``ogbench``."""

import contextlib
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import mujoco
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_skillgraph.envs.maze_geometry import MazeGeometry
from sb3_skillgraph.envs.mujoco_mazes import private_temporary_directory
from sb3_skillgraph.envs.task import GoalTask, Observation
from sb3_skillgraph.envs.wrappers import lies_down

_FULL_STATE = mujoco.mjtState.mjSTATE_INTEGRATION
#: By kind of body: numbers of the observation that are its position, the view of it, distance kept from walls.
_BODIES: dict[str, tuple[int, str, float]] = {"point": (0, "relative", 0.7), "ant": (2, "placed_body", 0.9)}


def adapted(env: gym.Env) -> gym.Env:
    """Return the goal environment that there is in place of OGBench's own, which is closed.

    What OGBench was told of the end of an episode (``max_episode_steps``, ``terminate_at_goal``) holds for it, too.

    :param env: ``pointmaze-*`` or ``antmaze-*`` as OGBench makes it
    """
    spec = env.spec
    assert spec is not None
    env.close()
    given: dict[str, Any] = {"terminate_on_success": bool(spec.kwargs.get("terminate_at_goal", False))}
    if spec.max_episode_steps:
        given["max_steps"] = spec.max_episode_steps
    body, maze = spec.id.split("maze-")
    kind, size = body.capitalize(), maze.partition("-")[0].capitalize()
    return gym.make(f"SkillGraph/OGBench{kind}{size}-v0", render_mode=env.render_mode, **given)


class OGBenchMazeEnv(GoalTask):
    """A maze of OGBench: ``pointmaze-giant-v0``, ``antmaze-teleport-v0``, ...

    Body, walls and teleporters are OGBench's; what is added is what a goal environment tells: Dict observations with the
    position (x, y) as the achieved goal, a success radius, starts and goals of one's choice. Every episode begins in the
    cell (1, 1), where OGBench's first task begins, unless ``reset`` or ``random_start`` says otherwise. Where a teleporter
    takes the body is seen on the step that it happens (OGBench shows the old position once more), and is drawn from the
    environment's own generator (OGBench draws from NumPy's global one). ``info["stuck"]`` is there, and True, once an ant has
    fallen on its back.

    :param name: OGBench's id of the environment
    :param render_mode: None or one of ``metadata["render_modes"]``
    :param success_radius: distance to the goal that counts as success; None for OGBench's (1.0 for the point, 0.5 for the
        ant)
    :param max_steps: steps after which an episode is truncated
    :param terminate_on_success: whether reaching the goal ends the episode
    :param random_start: whether episodes begin anywhere, instead of in the cell (1, 1): if they are short, none of them
        shows a long way
    :raises ImportError: without OGBench
    :raises ValueError: when it is no maze of the point or the ant, or an argument is unusable
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 (as Gymnasium has it)
    start_noise = 0.1
    #: Where OGBench draws starts and goals of its tasks: this far from the cell's centre at most, on both axes.
    task_noise = 1.0

    def __init__(
        self,
        name: str,
        render_mode: str | None = None,
        success_radius: float | None = None,
        max_steps: int = 1000,
        terminate_on_success: bool = False,
        random_start: bool = False,
    ) -> None:
        self.random_start = random_start
        try:
            import ogbench  # noqa: F401 - registers its environments
        except ImportError as error:
            raise ImportError("the mazes of OGBench need it: pip install 'sb3_skillgraph[ogbench]'") from error
        kind = name.partition("maze-")[0]
        if kind not in _BODIES:
            raise ValueError(f"there is no maze of OGBench {name!r} for a point or an ant, such as 'pointmaze-giant-v0'")
        self._skip, self.option_view, self.body_radius = _BODIES[kind]
        self.start_margin = 0.5 * self.body_radius
        try:
            with private_temporary_directory():  # OGBench leaves the model's file behind
                maze: Any = gym.make(name, terminate_at_goal=False).unwrapped
        except gym.error.Error as error:
            raise ValueError(f"OGBench has no maze {name!r}") from error
        self.maze = maze
        self.render_mode = render_mode
        radius = self.maze._goal_tol if success_radius is None else success_radius
        self.action_space = self.maze.action_space
        self._init_task(self._geometry(), radius, max_steps, terminate_on_success)
        n_numbers = len(self.maze.get_ob()) - self._skip
        position, body = (spaces.Box(-np.inf, np.inf, (n,), np.float64) for n in (2, n_numbers))
        self.observation_space = spaces.Dict({"observation": body, "achieved_goal": position, "desired_goal": position})
        self._place(self.goal)

    def _geometry(self) -> MazeGeometry:
        """Return the walls, in OGBench's coordinates: its first row is the lowest, its origin in the cell (1, 1)."""
        cells: list[list[int | str]] = self.maze.maze_map.tolist()
        cells[1][1] = "r"
        size = self.maze._maze_unit
        center = (size * (len(cells[0]) - 1) / 2 - size, size * (len(cells) - 1) / 2 - size)
        return MazeGeometry(cells[::-1], size, center)

    @property
    def tasks(self) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
        """OGBench's tasks: the centres of the cells of start and goal, each drawn up to ``task_noise`` around."""
        return [
            (np.array(task["init_xy"], dtype=float), np.array(task["goal_xy"], dtype=float)) for task in self.maze.task_infos
        ]

    def _draw_start(self) -> NDArray[np.float64]:
        return self.sample_free(self.np_random) if self.random_start else super()._draw_start()

    # -- what GoalTask asks for ---------------------------------------------------------------------------------------

    def _place(self, start: NDArray[np.float64]) -> None:
        self.maze.set_goal(goal_xy=self.goal)
        self.maze.set_state(self.maze.init_qpos.copy(), np.zeros_like(self.maze.init_qvel))
        self.maze.set_xy(start)

    def _advance(self, action: NDArray[np.float32]) -> None:
        with self._own_randomness():
            self.maze.step(action)

    def _observe(self) -> Observation:
        position = np.array(self.maze.get_xy(), dtype=np.float64)
        body = np.array(self.maze.get_ob(), dtype=np.float64)[self._skip :]
        return {"observation": body, "achieved_goal": position, "desired_goal": np.array(self.goal, dtype=np.float64)}

    def _is_stuck(self) -> bool:
        return self.option_view == "placed_body" and lies_down(self.maze.data.qpos[3:7])

    def _get_body_state(self) -> NDArray[np.float64]:
        state = np.empty(mujoco.mj_stateSize(self.maze.model, _FULL_STATE))
        mujoco.mj_getState(self.maze.model, self.maze.data, state, _FULL_STATE)
        return state

    def _set_body_state(self, state: NDArray[np.float64]) -> None:
        self.maze.set_goal(goal_xy=self.goal)
        mujoco.mj_setState(self.maze.model, self.maze.data, state, _FULL_STATE)
        mujoco.mj_forward(self.maze.model, self.maze.data)

    @contextlib.contextmanager
    def _own_randomness(self) -> Iterator[None]:
        """Let OGBench draw from a generator of this environment, where it would from NumPy's global one."""
        if self.maze._teleport_info is None:
            yield
            return
        before = np.random.get_state(legacy=False)  # noqa: NPY002
        np.random.seed(int(self.np_random.integers(2**32)))  # noqa: NPY002
        try:
            yield
        finally:
            np.random.set_state(before)  # noqa: NPY002

    def render(self) -> NDArray[np.uint8] | None:
        """Draw the maze from above.

        :return: the image, shape (height, width, 3), or None without a render mode
        """
        return self.maze.render() if self.render_mode is not None else None

    def close(self) -> None:
        """Let go of the simulator."""
        self.maze.close()
