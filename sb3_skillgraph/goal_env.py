"""What the agent needs to know of a goal environment."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, is_vecenv_wrapped, unwrap_vec_normalize

from sb3_skillgraph.checking import HUGE
from sb3_skillgraph.envs.bodies import BODY_NUMBERS, body_view, placed_body_view
from sb3_skillgraph.metric import Metric
from sb3_skillgraph.options.views import View, as_view, egocentric_view

KEYS = ("observation", "achieved_goal", "desired_goal")


class GoalSpec(NamedTuple):
    """Lengths of the flat observation, the goal and the action of a goal environment."""

    observation_dim: int
    goal_dim: int
    action_dim: int

    @classmethod
    def of(cls, observation_space: spaces.Space, action_space: spaces.Space) -> "GoalSpec":
        """Read the lengths off the spaces.

        :param observation_space: the environment's
        :param action_space: the environment's
        :raises ValueError: if they are not those of a goal environment with Box actions
        """
        wanted = "a Dict observation space with Box entries 'observation', 'achieved_goal' and 'desired_goal'"
        if not isinstance(observation_space, spaces.Dict) or any(key not in observation_space.spaces for key in KEYS):
            raise ValueError(
                f"SkillGraphAgent needs a goal environment ({wanted}), not {observation_space}. Where observations are a Box, "
                "sb3_skillgraph.envs.PursueGoals makes one."
            )
        others = [key for key, entry in observation_space.spaces.items() if not isinstance(entry, spaces.Box)]
        if others:
            raise ValueError(
                f"SkillGraphAgent needs {wanted}, and Boxes only; {others} are none in {observation_space}. Where goals are "
                "Dicts, sb3_skillgraph.envs.FlattenGoals makes vectors of them."
            )
        shapes = [observation_space[key].shape for key in KEYS]
        if shapes[1] != shapes[2] or shapes[1] is None or len(shapes[1]) != 1 or shapes[1][0] == 0:
            raise ValueError(
                "'achieved_goal' and 'desired_goal' must be vectors of the same length, at least 1, not of shapes "
                f"{shapes[1]} and {shapes[2]}."
            )
        if not isinstance(action_space, spaces.Box):
            raise ValueError(f"SkillGraphAgent needs continuous actions (a Box action space), not {action_space}.")
        if action_space.dtype.kind != "f" or 0 in action_space.shape:
            raise ValueError(f"SkillGraphAgent needs actions of floating point numbers, at least one, not {action_space}.")
        if not (np.isfinite(action_space.low).all() and np.isfinite(action_space.high).all()):
            raise ValueError(f"SkillGraphAgent needs an action space with finite bounds, not {action_space}.")
        sizes = [int(np.prod(shape)) for shape in (shapes[0] or (), shapes[1], action_space.shape)]
        return cls(*sizes)


def refuse_changed_goals(env: Any) -> None:
    """Refuse an environment that shows goals as something else.

    :param env: an environment or VecEnv
    :raises ValueError: if VecNormalize or VecFrameStack is around it
    """
    if isinstance(env, VecEnv) and is_vecenv_wrapped(env, VecFrameStack):
        raise ValueError(
            "VecFrameStack is not supported: it stacks goals, too, and a stack of positions is no place to go. Put what the "
            "agent should remember into 'observation' by a wrapper of your own."
        )
    if isinstance(env, VecEnv) and unwrap_vec_normalize(env) is not None:
        raise ValueError(
            "VecNormalize is not supported: events and initiation sets live in raw goal space. Networks see goal space in "
            "units of the event radius already; remove the wrapper."
        )


def rows(observation: dict[str, np.ndarray], key: str) -> np.ndarray:
    """Return one entry of a batch of observations as float32 rows.

    :param observation: Dict observation with a leading axis of environments
    :param key: name of the entry
    :return: shape ``(n_envs, dim)``
    """
    array = np.asarray(observation[key], dtype=np.float32)
    return array.reshape(len(array), -1)


def as_batch(observation: Any, space: spaces.Space) -> tuple[dict[str, np.ndarray], bool]:
    """Return one observation, or many, as float32 rows.

    :param observation: Dict observation with or without a leading axis
    :param space: the environment's observation space
    :return: rows by entry, each of shape ``(n, dim)``, and whether there was a leading axis
    :raises ValueError: if the observation does not fit the space, or is not finite
    """
    if not isinstance(observation, dict) or any(key not in observation for key in KEYS):
        raise ValueError(f"A Dict observation with {', '.join(KEYS)} is needed, not {type(observation).__name__}.")
    assert isinstance(space, spaces.Dict)
    vectorized = np.ndim(observation["achieved_goal"]) > 1
    batch = {}
    for key in KEYS:
        array = np.asarray(observation[key], dtype=np.float32)
        shape = space[key].shape
        if array.shape[int(vectorized) :] != shape:
            raise ValueError(f"{key!r} has shape {array.shape}; expected {shape}, or the same with a leading axis.")
        if not np.isfinite(array).all():
            raise ValueError(f"{key!r} holds NaN or inf: {array}.")
        batch[key] = array.reshape(len(array) if vectorized else 1, -1)
    return batch, vectorized


def as_goal(goal: Any, goal_dim: int) -> np.ndarray:
    """Return a point of goal space as an array.

    :param goal: anything array-like
    :param goal_dim: dimension of goal space
    :return: shape ``(goal_dim,)``
    :raises ValueError: if it is not a finite vector of that length
    """
    try:
        array = np.asarray(goal, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.full(0, np.nan)
    if array.shape != (goal_dim,) or not np.isfinite(array).all():
        raise ValueError(f"A goal must be a finite vector of shape ({goal_dim},), not {goal!r}.")
    return array


def check_finite(observation: dict[str, np.ndarray], step: int) -> None:
    """Refuse observations that hold NaN, inf or numbers beyond ``HUGE``.

    :param observation: Dict observation with a leading axis of environments
    :param step: number of environment steps taken so far
    :raises ValueError: naming the entry, the environment and the step
    """
    for key in KEYS:
        # The sum of squares tells at once that all is well; where it does not, the entry is looked at as it would be stored.
        if np.vdot(observation[key], observation[key]) < HUGE**2:
            continue
        array = rows(observation, key)
        good = np.abs(array) <= HUGE
        if not good.all():
            env = int(np.flatnonzero(~good.all(axis=1))[0])
            raise ValueError(
                f"{key!r} of environment {env} holds NaN, inf or a number beyond {HUGE:g} at step {step}: {array[env]}. The "
                "step was not stored; the agent can still be saved, and learning can go on after the environment is mended."
            )


def env_attribute(env: VecEnv, name: str) -> Any:
    """Return an attribute of the first environment, whatever wrappers lie around it; None if it has none."""
    return env.get_attr(name, indices=0)[0] if env.has_attr(name) else None


def find_view(view: str | View | None, env: VecEnv | None, spec: GoalSpec, metric: Metric) -> tuple[str | None, View]:
    """Return what a policy is to see.

    :param view: name of a view, a function, or None for what the environment names (else ``"relative"``)
    :param env: the environment
    :param spec: the environment's lengths
    :param metric: of goal space
    :return: the name (None for a function) and the function
    :raises ValueError: if there is no view of that name, or it cannot be one of that environment
    """
    if view is None:
        view = (env_attribute(env, "option_view") if env is not None else None) or "relative"
    function = as_view(view)
    n_joints = (spec.observation_dim - BODY_NUMBERS) // 2
    if function in (body_view, placed_body_view) and n_joints > spec.action_dim:
        raise ValueError(
            f"option_view {view!r} would take an observation of {spec.observation_dim} numbers for a body with {n_joints} "
            f"joints, but actions have {spec.action_dim}: there must be something else in it, such as contact forces "
            "(gymnasium-robotics' ant leaves them out with include_cfrc_ext_in_observation=False). For a body with joints "
            "that no motor moves give a function."
        )
    if function is egocentric_view and len(metric.embed(np.zeros(spec.goal_dim))) != spec.goal_dim:
        raise ValueError(
            f"option_view 'egocentric' leaves the achieved goal out of the observation, but with event_radius={metric!r} "
            "networks see other numbers of it: use 'relative' or a function."
        )
    return (None if callable(view) else view), function


class Oracle:
    """The feasible-state oracle of an environment: its method ``sample_free(rng)``.

    :param get_env: returns the VecEnv to ask (an agent's environment may be replaced)
    :raises ValueError: if the environment has no such method
    """

    def __init__(self, get_env: Callable[[], VecEnv | None]) -> None:
        self.get_env = get_env
        env = get_env()
        if env is not None and not env.has_attr("sample_free"):
            raise ValueError(
                "salience='rrt' needs a feasible-state oracle: an environment with a method sample_free(rng) that returns "
                "a reachable point of goal space. Without one use salience='frontier'."
            )

    def __call__(self, rng: np.random.Generator) -> np.ndarray:
        """Draw a feasible point, shape ``(goal_dim,)``."""
        env = self.get_env()
        assert env is not None, "salience='rrt' asks the environment; set_env first."
        # The environment may live in another process, which gets a copy of the generator: give it one of its own.
        child = np.random.default_rng(rng.integers(2**63))
        return np.asarray(env.env_method("sample_free", child, indices=0)[0], dtype=np.float64)


def describe_space(space: spaces.Space) -> dict[str, Any]:
    """Return a space of goal environments as plain data.

    :raises ValueError: if it is of another kind
    """
    if isinstance(space, spaces.Dict):
        return {"entries": {key: describe_space(entry) for key, entry in space.spaces.items()}}
    if isinstance(space, spaces.Box):
        return {"low": space.low, "high": space.high}
    raise ValueError(f"A space of this kind cannot be saved: {space}.")


def make_space(description: dict[str, Any]) -> spaces.Space:
    """Return the space that :func:`describe_space` described."""
    if "entries" in description:
        return spaces.Dict({key: make_space(entry) for key, entry in description["entries"].items()})
    low: np.ndarray = description["low"]
    return spaces.Box(low, description["high"], dtype=low.dtype)
