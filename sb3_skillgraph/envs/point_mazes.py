"""The point mazes, with the robot of one's choice."""

from typing import Any, Literal

from sb3_skillgraph.envs.car_maze import CarMazeEnv
from sb3_skillgraph.envs.mujoco_mazes import MujocoMazeTask, PointMazeEnv


def make_point_maze(robot: Literal["ball", "car"] = "ball", **kwargs: Any) -> MujocoMazeTask:
    """Make a point maze.

    :param robot: ``"ball"`` (:class:`~sb3_skillgraph.envs.mujoco_mazes.PointMazeEnv`, that of gymnasium-robotics) or
        ``"car"`` (:class:`~sb3_skillgraph.envs.car_maze.CarMazeEnv`, that of the paper)
    :param kwargs: arguments of its class
    :raises ValueError: when an argument is unusable
    """
    robots: dict[str, type[PointMazeEnv] | type[CarMazeEnv]] = {"ball": PointMazeEnv, "car": CarMazeEnv}
    if robot not in robots:
        raise ValueError(f"unknown robot {robot!r}: use 'ball' or 'car'")
    return robots[robot](**kwargs)
