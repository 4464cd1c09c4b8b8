"""Other people's environments that take more than an id: importing this registers ``Parking-v0``.

``benchmarks.foreign_envs:Parking-v0`` is highway-env's ``parking-v0``, which says when a goal is reached.
"""

from typing import Any

import gymnasium as gym
import numpy as np

from sb3_skillgraph.metric import Custom

#: What its reward is made of, in highway-env's configuration of the task: minus the square root of a weighted sum of absolute
#: differences; success is a reward above -0.12.
WEIGHTS, LEAST = np.array([1.0, 0.3, 0.0, 0.0, 0.02, 0.02]), 0.12


def parking_distance(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return how far apart two poses are, 1 and less where the reward calls it success, shape ``(...)``."""
    return np.asarray(np.sqrt(np.abs(a - b) @ WEIGHTS) / LEAST)


class Parking(gym.Wrapper):
    """highway-env's parking lot, which tells its metric."""

    goal_metric = Custom(parking_distance)


def make_parking(**kwargs: Any) -> gym.Env:
    """Make highway-env's parking lot."""
    import highway_env  # type: ignore[import-untyped, import-not-found, unused-ignore]  # noqa: F401

    env = gym.make("parking-v0", **kwargs)
    config = env.get_wrapper_attr("config")
    assert np.allclose(config["reward_weights"], WEIGHTS) and config["success_goal_reward"] == LEAST
    return Parking(env)


gym.register("Parking-v0", entry_point=make_parking)
