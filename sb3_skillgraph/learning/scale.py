"""Whether the event radius fits what the agent moves: looked at once, early, and told."""

import warnings

import numpy as np

from sb3_skillgraph.metric import Metric

#: Environment steps, of all environments, after which it is told.
LOOK_AT = 3_000
#: A step of so many radii, in the median, goes past events without being seen in them.
LONG_STEP = 2.0


class Scale:
    """Watches how far the agent moves in a step and in an episode.

    :param metric: of goal space
    """

    def __init__(self, metric: Metric) -> None:
        self.metric = metric
        self._steps: list[float] = []  # radii moved in each step
        self._extents: list[float] = []  # radii from where an episode began, at most, of every episode
        self._begins: list[np.ndarray | None] = []  # where the episode of each environment began
        self._far: list[float] = []  # and how far it has been from there

    def observe(self, before: np.ndarray, points: np.ndarray, dones: np.ndarray) -> bool:
        """Note a step.

        :param before: where the agents stood, shape ``(n_envs, goal_dim)``
        :param points: where they have got to, same shape
        :param dones: which episodes are over, shape ``(n_envs,)``
        :return: whether enough has been seen
        """
        if not self._begins:
            self._begins, self._far = [None] * len(points), [0.0] * len(points)
        self._steps += self.metric.travel(points, before).tolist()
        for i, begin in enumerate(self._begins):
            if begin is None:
                self._begins[i] = begin = before[i].copy()
            self._far[i] = max(self._far[i], float(self.metric.travel(points[i], begin)))
            if dones[i]:
                self._extents.append(self._far[i])
                self._begins[i], self._far[i] = None, 0.0
        return len(self._steps) >= LOOK_AT

    def tell(self) -> None:
        """Warn where the radius does not fit, with numbers."""
        step = float(np.median(self._steps))
        extents = self._extents or self._far
        extent = float(np.median(extents))
        if step > LONG_STEP:
            warnings.warn(
                f"A step is {step:.1f} event radii long in the median: the agent passes events without stopping in them. "
                f"event_radius={self.metric!r} is small for it; the environment's steps may be too long.",
                stacklevel=2,
            )
        if extent < 1.0:
            warnings.warn(
                f"In {len(extents)} episodes the achieved goal came {extent:.2g} event radii from its begin in the median "
                f"({max(extents):.2g} at most): it hardly moves, so that nearly all that the agent does happens in one event "
                "and there is no graph to plan on. If the goal is where an object is, only the walker learns, as SB3's HER "
                "does, until it moves the object; longer episodes, held actions (HoldAction) or a goal with the gripper in it "
                f"help. If not, event_radius={self.metric!r} is large for this environment.",
                stacklevel=2,
            )
