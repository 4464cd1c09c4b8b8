"""What an environment may need: a longer control period, to tell when its robot is stuck, flat goals, or goals at all."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from sb3_skillgraph.metric import Direction, Product, Within, as_metric

#: Names under which environments tell after how many steps an episode is truncated.
TIME_LIMITS = ("max_steps", "_max_episode_steps")
_UPRIGHT = 0.2  # upward component of the torso's axis below which it lies on its side or back


def time_limit(env: gym.Env) -> int | None:
    """Return after how many steps an environment truncates an episode; None if it does not tell.

    :param env: any environment
    """
    return told_limit(lambda name: env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None)


def told_limit(get: Callable[[str], Any]) -> int | None:
    """Return a time limit by the names in use, the least of several; None if there is none.

    :param get: returns an attribute of the environment, None if it has none
    """
    return min((int(limit) for limit in map(get, TIME_LIMITS) if limit), default=None)


class HoldAction(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """
    Holds every action for some steps, which become one: the control period of a robot that cannot use a shorter one.

    :param env: any environment
    :param n_steps: steps of the wrapped environment in one step
    :raises ValueError: if that is no whole number, or there is not one at least
    """

    def __init__(self, env: gym.Env, n_steps: int) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, n_steps=n_steps)
        gym.Wrapper.__init__(self, env)
        if not isinstance(n_steps, int | np.integer) or n_steps < 1:
            raise ValueError(f"n_steps must be a whole number of steps, at least 1, not {n_steps!r}.")
        self.n_steps = n_steps

    @property
    def max_steps(self) -> int:
        """Time limit, in steps of this environment.

        :raises AttributeError: if the wrapped environment names none
        """
        limit = time_limit(self.env)
        if limit is None:
            raise AttributeError("the wrapped environment names no time limit")
        return -(-limit // self.n_steps)

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take the same action again and again, until the episode is over or the agent is stuck.

        :param action: action of the wrapped environment
        :return: last observation, sum of the rewards, terminated, truncated and the last info
        """
        total = 0.0
        for _ in range(self.n_steps):
            observation, reward, terminated, truncated, info = self._step_once(action)
            total += float(reward)
            if terminated or truncated or info.get("stuck"):
                break
        return observation, total, terminated, truncated, info

    def _step_once(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        return self.env.step(action)


class TellStuck(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """
    Tells in ``info["stuck"]`` when the agent can do nothing any more; where the environment tells so itself, that stays.

    :param env: any environment
    :param is_stuck: function of an observation, such as :func:`on_its_back`
    """

    def __init__(self, env: gym.Env, is_stuck: Callable[[Any], bool]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, is_stuck=is_stuck)
        gym.Wrapper.__init__(self, env)
        self.is_stuck = is_stuck

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step.

        :param action: action of the wrapped environment
        :return: observation, reward, terminated, truncated and info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        stuck = bool(info.get("stuck")) or bool(self.is_stuck(observation))
        return observation, reward, terminated, truncated, {**info, "stuck": stuck}


def on_its_back(observation: dict[str, np.ndarray]) -> bool:
    """Tell whether a free body of MuJoCo lies on its side or back.

    :param observation: its ``observation`` begins with height and quaternion, as Gymnasium's ant's
    """
    return lies_down(observation["observation"][1:5])


def lies_down(quaternion: np.ndarray) -> bool:
    """Tell whether a body lies on its side or back.

    :param quaternion: its orientation (w, x, y, z)
    """
    _, x, y, _ = quaternion.tolist()
    return 1.0 - 2.0 * (x * x + y * y) <= _UPRIGHT


class AntRecipe(HoldAction):
    """
    gymnasium-robotics' ants as the recipe for ants wants them: with the torque and the control period of D4RL's ant.

    An action is held for two steps of the environment, which become one of 0.1 s, at a fifth of the torque; contact forces
    are left out of the observation; ``info["stuck"]`` tells when the ant lies on its back.

    :param env: ``AntMaze_*`` of gymnasium-robotics
    :raises ValueError: if it is no ant in a maze
    """

    option_view = "placed_body"
    torque = 0.2
    n_body = 27  # numbers of the observation that are positions and velocities; contact forces may follow

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        super().__init__(env, n_steps=2)
        space = env.observation_space
        body = space["observation"] if isinstance(space, spaces.Dict) and "observation" in space.spaces else space
        if not isinstance(space, spaces.Dict) or not isinstance(body, spaces.Box) or body.shape[0] < self.n_body:
            raise ValueError(f"AntRecipe is for gymnasium-robotics' AntMaze_*, which observe a body, and this is {space}.")
        low, high = body.low[: self.n_body], body.high[: self.n_body]
        shorter = spaces.Box(low, high, dtype=body.dtype.type)
        self.observation_space = spaces.Dict({**space.spaces, "observation": shorter})

    def _seen(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {**observation, "observation": observation["observation"][: self.n_body]}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: those of the wrapped environment
        :return: observation and info
        """
        observation, info = self.env.reset(seed=seed, options=options)
        return self._seen(observation), info

    def _step_once(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(self.torque * action)
        return self._seen(observation), reward, terminated, truncated, {**info, "stuck": on_its_back(observation)}


class FlattenGoals(gym.ObservationWrapper, gym.utils.RecordConstructorArgs):
    """
    Makes one vector of goals that are nested dictionaries, such as those of gymnasium-robotics' FrankaKitchen.

    A goal is reached where each of its entries is within ``radius`` of what it should be, which ``goal_metric`` tells.

    :param env: an environment whose goals are Dicts of Boxes
    :param radius: of every entry, in its own units, or of each by name
    :raises ValueError: if its goals are no such dictionaries, or the names are others
    """

    def __init__(self, env: gym.Env, radius: float | dict[str, float]) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, radius=radius)
        gym.ObservationWrapper.__init__(self, env)
        space = env.observation_space
        goals = space["achieved_goal"] if isinstance(space, spaces.Dict) and "achieved_goal" in space.spaces else space
        if not isinstance(space, spaces.Dict) or not isinstance(goals, spaces.Dict) or goals is space:
            raise ValueError(f"FlattenGoals is for goals that are Dicts of Boxes; these are {goals}.")
        flat = spaces.flatten_space(goals)
        self.observation_space = spaces.Dict({**space.spaces, "achieved_goal": flat, "desired_goal": flat})
        self._goals = goals
        if isinstance(radius, dict) and set(radius) != set(goals.spaces):
            raise ValueError(f"There must be a radius for each of {', '.join(goals.spaces)}, not for {', '.join(radius)}.")
        parts, first = [], 0
        for name, box in goals.spaces.items():
            last = first + spaces.flatdim(box)
            parts.append(Within(range(first, last), radius[name] if isinstance(radius, dict) else radius))
            first = last
        self.goal_metric = Product(*parts)

    def observation(self, observation: Any) -> dict[str, Any]:
        """Return an observation with flat goals, shape ``(goal_dim,)``.

        :param observation: of the wrapped environment
        """
        return {
            **observation,
            **{key: spaces.flatten(self._goals, observation[key]) for key in ("achieved_goal", "desired_goal")},
        }


def flat_kitchen(env: gym.Env) -> FlattenGoals:
    """Make vectors of the goals of gymnasium-robotics' FrankaKitchen, whose tasks are done within its own threshold.

    :param env: ``FrankaKitchen-v1``
    """
    from gymnasium_robotics.envs.franka_kitchen.kitchen_env import BONUS_THRESH

    return FlattenGoals(env, BONUS_THRESH)


class Parking(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """
    highway-env's ``parking-v0``, telling when a car is parked, and that one which has crashed is stuck.

    Its own rule is a weighted sum of how far off x, y and the heading (as cosine and sine) are. All but the corners of what is
    near enough to count here does there, too.

    :param env: ``parking-v0`` with its own weights
    :raises ValueError: if it is another environment
    """

    goal_metric = Product(Within([0], 0.005), Within([1], 0.015), Direction([4, 5], 0.25))

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        if not env.has_wrapper_attr("config") or "duration" not in env.get_wrapper_attr("config"):
            raise ValueError(f"Parking is for highway-env's parking-v0, and this is {env}.")

    @property
    def max_steps(self) -> int:
        """Steps after which it gives up: its limit is in seconds."""
        config = self.env.get_wrapper_attr("config")
        return int(config["duration"] * config["policy_frequency"])

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step.

        :param action: action of the wrapped environment
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated, {**info, "stuck": bool(info["crashed"])}


class PursueGoals(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """
    Makes a goal environment of any environment with Box observations.

    At each reset a goal is drawn; ``reset(options={"goal": ...})`` gives one. ``info["is_success"]`` tells whether it is
    reached now, the reward is 1 then and 0 elsewhere.

    :param env: an environment with Box observations
    :param achieved_goal: function of an observation: where the agent has got to, shape ``(goal_dim,)``
    :param sample_goal: function of a generator: a goal, same shape
    :param radius: how near a goal is reached, as the agent's ``event_radius`` has it
    :raises ValueError: if observations are no Box, or the two functions do not fit
    """

    def __init__(
        self,
        env: gym.Env,
        achieved_goal: Callable[[np.ndarray], np.ndarray],
        sample_goal: Callable[[np.random.Generator], np.ndarray],
        radius: Any,
    ) -> None:
        gym.utils.RecordConstructorArgs.__init__(self, achieved_goal=achieved_goal, sample_goal=sample_goal, radius=radius)
        gym.Wrapper.__init__(self, env)
        if not isinstance(env.observation_space, spaces.Box):
            raise ValueError(f"PursueGoals is for environments with Box observations, not {env.observation_space}.")
        self._achieved_goal, self._sample_goal = achieved_goal, sample_goal
        shape = self._achieved(np.zeros(env.observation_space.shape, dtype=env.observation_space.dtype)).shape
        self.goal = self._drawn(np.random.default_rng(0))
        if len(shape) != 1 or self.goal.shape != shape:
            raise ValueError(
                f"Achieved goals have shape {shape} and sampled ones {self.goal.shape}: both must be (goal_dim,)."
            )
        self.goal_metric = as_metric(radius)
        self.goal_metric.check(shape[0])
        goals = spaces.Box(-np.inf, np.inf, shape, np.float64)
        self.observation_space = spaces.Dict(observation=env.observation_space, achieved_goal=goals, desired_goal=goals)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with a goal.

        :param seed: seed of the environment and of the goals
        :param options: ``"goal"``, shape ``(goal_dim,)``; what else there is goes to the wrapped environment
        :raises ValueError: if a goal is given that is no finite vector of its length
        """
        options = dict(options or {})
        given = options.pop("goal", None)
        observation, info = self.env.reset(seed=seed, options=options or None)
        drawn = self._drawn(self.np_random)
        self.goal = drawn if given is None else np.asarray(given, dtype=np.float64)
        if self.goal.shape != drawn.shape or not np.isfinite(self.goal).all():
            raise ValueError(f"A goal must be a finite vector of shape {drawn.shape}, not {given!r}.")
        shown = self._shown(observation)
        return shown, {**info, "is_success": self._is_reached(shown)}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step.

        :param action: action of the wrapped environment
        """
        observation, _, terminated, truncated, info = self.env.step(action)
        shown = self._shown(observation)
        success = self._is_reached(shown)
        return shown, float(success), terminated, truncated, {**info, "is_success": success}

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Return 1 where a goal is reached and 0 elsewhere, shape ``(...)``; for relabelling.

        :param achieved_goal: shape ``(..., goal_dim)``
        :param desired_goal: same shape
        :param info: not used
        """
        return np.asarray(self.goal_metric.distance(achieved_goal, desired_goal) <= self.goal_metric.radius, dtype=np.float64)

    def _achieved(self, observation: np.ndarray) -> np.ndarray:
        return np.asarray(self._achieved_goal(observation), dtype=np.float64)

    def _drawn(self, rng: np.random.Generator) -> np.ndarray:
        return np.asarray(self._sample_goal(rng), dtype=np.float64)

    def _shown(self, observation: np.ndarray) -> dict[str, np.ndarray]:
        return {"observation": observation, "achieved_goal": self._achieved(observation), "desired_goal": self.goal.copy()}

    def _is_reached(self, shown: dict[str, np.ndarray]) -> bool:
        return self.goal_metric.reached(shown["achieved_goal"], self.goal)
