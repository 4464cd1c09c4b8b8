"""What a goal environment may need before its robot can learn: a longer control period, and to tell when it is stuck."""

from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np

_UPRIGHT = 0.2  # upward component of the torso's axis below which it lies on its side or back


class HoldAction(gym.Wrapper):
    """
    Holds every action for some steps, which become one: the control period of a robot that cannot use a shorter one.

    :param env: any environment
    :param n_steps: steps of the wrapped environment in one step
    :raises ValueError: if that is no whole number, or there is not one at least
    """

    def __init__(self, env: gym.Env, n_steps: int) -> None:
        super().__init__(env)
        if not isinstance(n_steps, int | np.integer) or n_steps < 1:
            raise ValueError(f"n_steps must be a whole number of steps, at least 1, not {n_steps!r}.")
        self.n_steps = n_steps

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take the same action again and again, until the episode is over or the agent is stuck.

        :param action: action of the wrapped environment
        :return: last observation, sum of the rewards, terminated, truncated and the last info
        """
        total = 0.0
        for _ in range(self.n_steps):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += float(reward)
            if terminated or truncated or info.get("stuck"):
                break
        return observation, total, terminated, truncated, info


class TellStuck(gym.Wrapper):
    """
    Tells in ``info["stuck"]`` when the agent can do nothing any more; where the environment tells so itself, that stays.

    :param env: any environment
    :param is_stuck: function of an observation, such as :func:`on_its_back`
    """

    def __init__(self, env: gym.Env, is_stuck: Callable[[Any], bool]) -> None:
        super().__init__(env)
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
