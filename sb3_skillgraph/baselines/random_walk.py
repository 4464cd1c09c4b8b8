"""The least that any agent must beat."""

from typing import Any

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
