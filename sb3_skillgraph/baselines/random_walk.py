"""The least that any agent must beat."""

from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces


class RandomWalk:
    """Takes a uniformly random action at every step, whatever the goal.

    :param action_space: the environment's
    :param seed: seed of the actions
    """

    def __init__(self, action_space: spaces.Box, seed: int) -> None:
        self.action_space = action_space
        self.rng = np.random.default_rng(seed)

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Draw an action; the arguments are SB3's, and not used.

        :param observation: one observation
        :param state: not used
        :param episode_start: not used
        :param deterministic: not used
        :return: an action in the environment's own bounds, and the state
        """
        action = self.rng.uniform(self.action_space.low, self.action_space.high)
        return action.astype(self.action_space.dtype), state


def random_walk(env: gym.Env, seed: int, n_steps: int) -> np.ndarray:
    """Go where chance leads, again and again from the environment's own start; a walk that is stuck is over.

    :param env: a goal environment; it is closed afterwards
    :param seed: of the actions and of the environment
    :param n_steps: environment steps
    :return: the goals achieved, shape ``(n_steps, goal_dim)``
    """
    assert isinstance(env.action_space, spaces.Box)
    walker, points = RandomWalk(env.action_space, seed), []
    observation, _ = env.reset(seed=seed)
    for _ in range(n_steps):
        observation, _, terminated, truncated, info = env.step(walker.predict(observation)[0])
        points.append(observation["achieved_goal"])
        if terminated or truncated or info.get("stuck"):
            observation, _ = env.reset()
    env.close()
    return np.array(points)
