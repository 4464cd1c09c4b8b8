"""What an option's policy sees: one function of (observation, achieved goal, goal)."""

from collections.abc import Callable

import numpy as np

from sb3_skillgraph.envs.bodies import body_view, placed_body_view
from sb3_skillgraph.metric import Metric

View = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def relative_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """See everything, and the goal from where the agent stands.

    :param observation: shape ``(n, observation_dim)``
    :param achieved_goal: shape ``(n, goal_dim)``
    :param goal: shape ``(n, goal_dim)``
    :return: shape ``(n, observation_dim + 2 * goal_dim)``
    """
    return np.concatenate([observation, achieved_goal, goal - achieved_goal], axis=1)


def egocentric_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Leave absolute position out: for tasks whose ``observation`` begins with the achieved goal.

    A skill that does not know where it is works wherever it is put; it needs far fewer steps to learn.

    :param observation: shape ``(n, observation_dim)``, its first ``goal_dim`` entries the achieved goal
    :param achieved_goal: shape ``(n, goal_dim)``
    :param goal: shape ``(n, goal_dim)``
    :return: shape ``(n, observation_dim)``
    """
    return np.concatenate([observation[:, achieved_goal.shape[1] :], goal - achieved_goal], axis=1)


VIEWS: dict[str, View] = {
    "relative": relative_view,
    "egocentric": egocentric_view,
    "body": body_view,
    "placed_body": placed_body_view,
}


def as_view(view: str | View | None) -> View:
    """Return the view that an environment or an argument names.

    :param view: name, function, or None for ``"relative"``
    :raises ValueError: if there is no view of that name
    """
    if callable(view):
        return view
    name = "relative" if view is None else view
    if name not in VIEWS:
        raise ValueError(f"Unknown option_view {name!r}: use one of {sorted(VIEWS)} or a function.")
    return VIEWS[name]


class ScaledView:
    """A view whose goal space is measured in event radii, so that networks see numbers of order one.

    Positions and offsets of 0.05 m (an arm) and of 4 m (an ant) then look alike to a policy. The function it wraps
    still gets what it expects: ``achieved_goal`` and ``goal``, both as the metric shows them to networks.

    :param function: the view
    :param metric: of goal space
    """

    def __init__(self, function: View, metric: Metric) -> None:
        self.function = function
        self.metric = metric

    def __call__(self, observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return what the policy sees, float32 of shape ``(n, dim)``."""
        seen = self.function(observation, self.metric.embed(achieved_goal), self.metric.embed(goal))
        return np.ascontiguousarray(seen, dtype=np.float32)

    def dim(self, observation_dim: int, goal_dim: int) -> int:
        """Return the length of what the policy sees."""
        zeros = np.zeros((1, goal_dim), dtype=np.float32)
        return self(np.zeros((1, observation_dim), dtype=np.float32), zeros, zeros).shape[1]
