"""Maze tasks for skill graphs; importing this package registers ``SkillGraph/*`` with Gymnasium."""

import importlib
from typing import Any

import gymnasium as gym

from sb3_skillgraph.envs.maze_geometry import LARGE_MAZE, MEDIUM_MAZE, OPEN_AREA, U_MAZE, MazeGeometry, MazeMap
from sb3_skillgraph.envs.task import GoalTask
from sb3_skillgraph.envs.toy import ToyMazeEnv
from sb3_skillgraph.envs.wrappers import AntRecipe, FlattenGoals, HoldAction, Parking, PursueGoals, TellStuck, on_its_back

__all__ = [
    "LARGE_MAZE",
    "MEDIUM_MAZE",
    "OPEN_AREA",
    "U_MAZE",
    "AntRecipe",
    "FlattenGoals",
    "GoalTask",
    "HoldAction",
    "MazeGeometry",
    "MazeMap",
    "Parking",
    "PursueGoals",
    "TellStuck",
    "ToyMazeEnv",
    "find",
    "geometry_of",
    "on_its_back",
    "register",
]

# Entry points are names: MuJoCo is imported when an environment that needs it is made.
_POINT = "sb3_skillgraph.envs.point_mazes:make_point_maze"
_ANT = "sb3_skillgraph.envs.mujoco_mazes:AntMazeEnv"
_OGBENCH = "sb3_skillgraph.envs.ogbench_mazes:OGBenchMazeEnv"
_TOY = "sb3_skillgraph.envs.toy:ToyMazeEnv"
_TASKS: dict[str, tuple[str, dict[str, Any]]] = {
    "SkillGraph/PointMazeUMaze-v0": (_POINT, {"maze_map": U_MAZE}),
    "SkillGraph/PointMazeMedium-v0": (_POINT, {"maze_map": MEDIUM_MAZE}),
    "SkillGraph/PointMazeHard-v0": (_POINT, {"maze_map": LARGE_MAZE}),
    "SkillGraph/PointMaze-v0": (_POINT, {}),
    "SkillGraph/PointKeyDoor-v0": ("sb3_skillgraph.envs.key_door:PointKeyDoorEnv", {}),
    "SkillGraph/AntUMaze-v0": (_ANT, {"maze_map": U_MAZE}),
    "SkillGraph/AntReacher-v0": (_ANT, {"maze_map": OPEN_AREA}),
    "SkillGraph/AntMedium-v0": (_ANT, {"maze_map": MEDIUM_MAZE}),
    "SkillGraph/AntLarge-v0": (_ANT, {"maze_map": LARGE_MAZE}),
    "SkillGraph/AntMaze-v0": (_ANT, {}),
    "SkillGraph/ToyMaze-v0": (_TOY, {}),
    **{
        f"SkillGraph/OGBench{body.capitalize()}{maze.capitalize()}-v0": (_OGBENCH, {"name": f"{body}maze-{maze}-v0"})
        for body in ("point", "ant")
        for maze in ("medium", "large", "giant", "teleport")
    },
}


def register() -> None:
    """Register the ``SkillGraph/*`` environments with Gymnasium; those already there are left alone.

    They bring their own time limit (``max_steps``), so that it is part of their state, and no ``max_episode_steps``.
    """
    for env_id, (entry_point, kwargs) in _TASKS.items():
        if env_id not in gym.registry:
            gym.register(env_id, entry_point=entry_point, kwargs=kwargs)


def find(env_id: str) -> None:
    """See to it that an environment is registered: import the package that its id names, else gymnasium-robotics or OGBench.

    :param env_id: ``"package:Name-v0"``, or the id of an environment that is registered, of gymnasium-robotics, or of a maze
        of OGBench
    :raises ImportError: if the package cannot be imported
    :raises gymnasium.error.Error: if there is no such environment
    """
    package, _, name = env_id.rpartition(":")
    if package:
        importlib.import_module(package)
    elif name not in gym.registry:
        # When it is asked for: it takes a while to import; after the module that keeps its import quiet.
        import sb3_skillgraph.envs.mujoco_mazes  # noqa: F401, I001
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
        if name.startswith(("pointmaze-", "antmaze-")):
            importlib.import_module("ogbench")
    gym.spec(name)


def geometry_of(env: gym.Env) -> MazeGeometry | None:
    """Return the walls of a maze of ours or of gymnasium-robotics; None for any other environment.

    :param env: the environment
    """
    if env.has_wrapper_attr("geometry"):
        geometry: MazeGeometry = env.get_wrapper_attr("geometry")
        return geometry
    maze: Any = getattr(env.unwrapped, "maze", None)
    return MazeGeometry(maze.maze_map, maze.maze_size_scaling) if hasattr(maze, "maze_size_scaling") else None


register()
