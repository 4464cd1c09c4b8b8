"""When other people's environments count a goal as reached."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
from gymnasium import spaces

from sb3_skillgraph.metric import Metric, Product, Rotation, Tilt, Within, as_metric

#: Metres within which the goals of gymnasium-robotics' ``PointMaze_*`` and ``AntMaze_*`` count as reached.
ROBOTICS_MAZE_RADIUS = 0.45
#: Numbers of a pose: where it is, and a quaternion.
POSE_DIM = 7


def env_metric(get: Callable[[str], Any], goal_dim: int) -> Metric | None:
    """Return when an environment counts a goal as reached, by the names in use; None if it does not tell.

    :param get: returns an attribute of the environment, None if it has none
    :param goal_dim: length of a goal
    :raises ValueError: if what it tells is no metric
    """
    names = ("goal_metric", "success_radius", "distance_threshold")
    radius = next((value for value in map(get, names) if value is not None), None)
    if radius is None:
        # These are asked last: a task, or a maze, may be something that cannot leave its process
        radius = getattr(get("task"), "distance_threshold", None)  # panda-gym
    if radius is None and hasattr(get("maze"), "maze_size_scaling"):
        radius = ROBOTICS_MAZE_RADIUS  # gymnasium-robotics' mazes have a number in their code, and no name for it
    turn = get("rotation_threshold")
    if turn is not None and goal_dim == POSE_DIM and radius is not None:
        return _pose_metric(get, radius, turn)
    return None if radius is None else as_metric(radius)


def metric_of(env: gym.Env) -> Metric | None:
    """Return when one environment counts a goal as reached; None if it does not tell.

    :param env: a goal environment
    :raises ValueError: if it is none, or what it tells is no metric
    """
    if not isinstance(env.observation_space, spaces.Dict) or "desired_goal" not in env.observation_space.spaces:
        raise ValueError(f"Goals are reached in goal environments (Dict observations), and {env} is none.")
    goal_dim = len(env.observation_space["desired_goal"].sample())
    return env_metric(lambda name: env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None, goal_dim)


def _pose_metric(get: Callable[[str], Any], radius: float, turn: float) -> Metric:
    """Return the metric of poses (x, y, z, quaternion) as gymnasium-robotics' hands have them."""
    kind = Tilt if get("ignore_z_target_rotation") else Rotation
    place, rotation = Within(range(3), radius), kind(range(3, POSE_DIM), turn)
    if get("target_position") == "ignore":
        return Product(rotation)
    if get("target_rotation") == "ignore":
        return Product(place)
    return Product(place, rotation)
