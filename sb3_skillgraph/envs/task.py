"""What all maze tasks share: start and goal of an episode, success, the time limit, and saving all of it."""

import contextlib
import math
from abc import abstractmethod
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

from sb3_skillgraph.envs.maze_geometry import MazeGeometry

Observation = dict[str, NDArray[np.float64]]
State = dict[str, NDArray[Any]]

_LOW_64_BITS = 2**64 - 1


def encode_rng(rng: np.random.Generator) -> NDArray[np.uint64]:
    """Write the state of a generator as an array.

    :param rng: a generator over PCG64, as Gymnasium makes them
    :return: its state, shape (6,)
    """
    state = rng.bit_generator.state
    words: list[int] = []
    for number in (state["state"]["state"], state["state"]["inc"]):
        words += [number >> 64, number & _LOW_64_BITS]
    return np.array([*words, state["has_uint32"], state["uinteger"]], dtype=np.uint64)


def decode_rng(rng: np.random.Generator, words: NDArray[np.uint64]) -> None:
    """Give a generator the state that :func:`encode_rng` has written.

    :param rng: a generator over PCG64; it is changed in place
    :param words: the state, shape (6,)
    :raises ValueError: if no generator has such a state
    """
    state_high, state_low, inc_high, inc_low, has_uint32, uinteger = (int(word) for word in words)
    if inc_low % 2 == 0:
        raise ValueError("the state has a generator with an even increment, which may draw the same for ever")
    rng.bit_generator.state = {
        "bit_generator": "PCG64",
        "state": {"state": state_high << 64 | state_low, "inc": inc_high << 64 | inc_low},
        "has_uint32": has_uint32,
        "uinteger": uinteger,
    }


class GoalTask(gym.Env[Any, NDArray[np.float32]]):
    """A goal-reaching task in a maze.

    An episode starts at the maze's start cell plus uniform noise, unless ``reset`` is told otherwise, and has a goal
    drawn uniformly over free space. The reward is 1 within ``success_radius`` of the goal and 0 elsewhere. The episode
    is truncated after ``max_steps`` steps; it terminates only with ``terminate_on_success``. The ``info`` of ``reset``
    and of each step holds ``success`` (at the goal now) and ``is_success`` (at the goal at any time of the episode).

    A subclass calls :meth:`_init_task` and supplies the five methods that move the body. It may come before another
    environment class in the list of bases, which is why this class has no ``__init__``.
    """

    #: What an option's policy sees by default, see :mod:`sb3_skillgraph.options.views`.
    option_view: str
    #: Distance that sampled positions keep from walls, in world units.
    body_radius: float
    #: Distance that a start given to ``reset`` must keep from walls, in world units.
    start_margin: float
    #: Half side of the square of the start noise, in world units.
    start_noise: float = 0.1

    def _init_task(self, geometry: MazeGeometry, success_radius: float, max_steps: int, terminate_on_success: bool) -> None:
        """Set up the task.

        :param geometry: the maze
        :param success_radius: distance to the goal that counts as success, in world units
        :param max_steps: steps after which an episode is truncated
        :param terminate_on_success: whether reaching the goal ends the episode
        :raises ValueError: when the radius or the number of steps is not positive
        """
        if not (math.isfinite(success_radius) and success_radius > 0):
            raise ValueError(f"success_radius must be a positive number, not {success_radius!r}")
        if max_steps < 1:
            raise ValueError(f"max_steps must be at least 1, not {max_steps!r}")
        self.geometry = geometry
        self.success_radius = float(success_radius)
        self.max_steps = int(max_steps)
        self.terminate_on_success = bool(terminate_on_success)
        self.goal = geometry.cell_to_xy(*geometry.start_cell)
        self._elapsed_steps = 0
        self._has_succeeded = False

    @abstractmethod
    def _place(self, start: NDArray[np.float64]) -> None:
        """Put the body at rest at a position, with ``self.goal`` as the goal.

        :param start: position, shape (2,)
        """

    @abstractmethod
    def _advance(self, action: NDArray[np.float32]) -> None:
        """Move the body for one step.

        :param action: an element of the action space
        """

    @abstractmethod
    def _observe(self) -> Observation:
        """Read the present observation.

        :return: arrays ``observation``, ``achieved_goal`` and ``desired_goal``
        """

    @abstractmethod
    def _get_body_state(self) -> NDArray[np.float64]:
        """Read all that the motion of the body depends on.

        :return: the state of the simulator, one-dimensional
        """

    @abstractmethod
    def _set_body_state(self, state: NDArray[np.float64]) -> None:
        """Restore what :meth:`_get_body_state` has read; ``self.goal`` is set already.

        :param state: the state of the simulator, one-dimensional
        """

    def sample_free(self, rng: np.random.Generator) -> NDArray[np.float64]:
        """Draw a position uniformly over the area where the body fits.

        :param rng: source of randomness
        :return: position, shape (2,)
        """
        return self.geometry.sample_free(rng, self.body_radius)

    def _draw_start(self) -> NDArray[np.float64]:
        """Draw where an episode begins, shape (2,)."""
        noise = self.np_random.uniform(-self.start_noise, self.start_noise, size=2)
        return self.geometry.cell_to_xy(*self.geometry.start_cell) + noise

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode.

        The default start and the goal are drawn even where the options replace them, so that what later episodes draw
        does not depend on the options.

        :param seed: seed of the environment's generator; None leaves it as it is
        :param options: ``"start"`` and ``"goal"``, each an (x, y) in free space; either may be left out or None
        :return: observation and info
        :raises ValueError: when an option is unknown, no position, or not in free space
        """
        given = self._check_options(options or {})
        super().reset(seed=seed)
        start = self._draw_start()
        goal = self.sample_free(self.np_random)
        self.goal = given.get("goal", goal)
        self._elapsed_steps = 0
        self._has_succeeded = False
        self._place(given.get("start", start))
        observation = self._observe()
        return observation, self._make_info(self._is_at_goal(observation))

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Move for one step.

        :param action: an element of the action space
        :return: observation, reward, terminated, truncated, info
        """
        self._advance(action)
        self._elapsed_steps += 1
        observation = self._observe()
        success = self._is_at_goal(observation)
        terminated = self.terminate_on_success and success
        truncated = self._elapsed_steps >= self.max_steps
        return observation, float(success), terminated, truncated, self._make_info(success)

    def _is_at_goal(self, observation: Observation) -> bool:
        # Plain floats: several times faster than NumPy on two numbers, and the same rounding as compute_reward.
        x, y = observation["achieved_goal"].tolist()
        goal_x, goal_y = self.goal.tolist()
        dx, dy = x - goal_x, y - goal_y
        return math.sqrt(dx * dx + dy * dy) <= self.success_radius

    def _make_info(self, success: bool) -> dict[str, Any]:
        self._has_succeeded = self._has_succeeded or success
        info = {"success": success, "is_success": self._has_succeeded}
        return {**info, "stuck": True} if self._is_stuck() else info

    def _is_stuck(self) -> bool:
        """Tell whether the body can do nothing any more."""
        return False

    def _check_options(self, options: dict[str, Any]) -> dict[str, NDArray[np.float64]]:
        margins = {"start": self.start_margin, "goal": 0.0}
        unknown = sorted(set(options) - set(margins))
        if unknown:
            raise ValueError(f"unknown reset options {unknown}: the options are 'start' and 'goal', each an (x, y)")
        return {name: self._check_position(name, value, margins[name]) for name, value in options.items() if value is not None}

    def _check_position(self, name: str, value: Any, margin: float) -> NDArray[np.float64]:
        with contextlib.suppress(TypeError, ValueError):
            position = np.array(value, dtype=np.float64)
            if position.shape == (2,) and self.geometry.is_free(position, margin).all():
                return position
        x_min, x_max, y_min, y_max = self.geometry.extent
        raise ValueError(
            f"reset option {name!r} is {value!r}: it must be two finite numbers (x, y) in free space, more than "
            f"{margin:g} away from every wall of the maze, which covers x from {x_min:g} to {x_max:g} and y from "
            f"{y_min:g} to {y_max:g}"
        )

    def compute_reward(
        self, achieved_goal: NDArray[np.float64], desired_goal: NDArray[np.float64], info: Any
    ) -> NDArray[np.float64] | np.float64:
        """Reward of having reached a position when a goal was wanted; for relabelling.

        :param achieved_goal: positions reached, shape (2,) or (n, 2)
        :param desired_goal: goals, same shape
        :param info: not used
        :return: 1 within ``success_radius`` and 0 elsewhere, a number or shape (n,)
        """
        return self._are_near(achieved_goal, desired_goal).astype(np.float64)

    def compute_terminated(self, achieved_goal: NDArray[np.float64], desired_goal: NDArray[np.float64], info: Any) -> bool:
        """Whether having reached a position ends the episode when a goal was wanted.

        :param achieved_goal: position reached, shape (2,)
        :param desired_goal: goal, shape (2,)
        :param info: not used
        :return: True with ``terminate_on_success`` within ``success_radius``
        """
        return self.terminate_on_success and bool(self._are_near(achieved_goal, desired_goal))

    def compute_truncated(self, achieved_goal: NDArray[np.float64], desired_goal: NDArray[np.float64], info: Any) -> bool:
        """Whether the time limit has been reached.

        :param achieved_goal: not used
        :param desired_goal: not used
        :param info: not used
        :return: True from step ``max_steps`` of the episode on
        """
        return self._elapsed_steps >= self.max_steps

    def _are_near(self, a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.bool_] | np.bool_:
        difference = np.asarray(a) - np.asarray(b)
        return np.sqrt((difference**2).sum(axis=-1)) <= self.success_radius

    def get_state(self) -> State:
        """Read all that what follows depends on, the next episodes included.

        The generators of the spaces are left out: the environment does not sample from its spaces.

        :return: arrays ``body`` (the simulator), ``goal``, ``elapsed_steps``, ``has_succeeded`` and ``rng``
        """
        return {
            "body": self._get_body_state(),
            "goal": self.goal.copy(),
            "elapsed_steps": np.array(self._elapsed_steps),
            "has_succeeded": np.array(self._has_succeeded),
            "rng": encode_rng(self.np_random),
        }

    def set_state(self, state: State) -> None:
        """Restore what :meth:`get_state` has read, here or in another environment with the same maze.

        :param state: the arrays of :meth:`get_state`
        :raises ValueError: when an array is missing or has another shape than here
        """
        shapes = {name: array.shape for name, array in self.get_state().items()}
        given = {name: np.shape(array) for name, array in state.items()}
        if shapes != given:
            raise ValueError(f"the state has arrays of shapes {given}; this environment takes {shapes}")
        self.goal = np.array(state["goal"], dtype=np.float64)
        self._elapsed_steps = int(state["elapsed_steps"])
        self._has_succeeded = bool(state["has_succeeded"])
        decode_rng(self.np_random, state["rng"])
        self._set_body_state(state["body"])
