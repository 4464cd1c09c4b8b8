"""The skill graph as a high level for an :class:`~sb3_skillgraph.OptionsEnv` (sections 3.2.4, 3.3)."""

from typing import NamedTuple

import numpy as np

from sb3_skillgraph.planner import GraphPlanner
from sb3_skillgraph.smdp.options_env import MASK, OptionsEnv

PATIENCE = 4  # stretches walked by the global option after which the next best way is tried


class GraphPolicyState(NamedTuple):
    """What is remembered between decisions; arrays of shape ``(n_envs,)``.

    :param action: the last action, ``-1`` for none
    :param failures: how often the global option has run without reaching the goal
    :param failed: the option that failed last, ``-1`` for none
    """

    action: np.ndarray
    failures: np.ndarray
    failed: np.ndarray


class GraphPolicy:
    """
    Chooses options by planning over a skill graph, anew at every decision.

    It has SB3's ``predict`` and so is exchangeable with :class:`~sb3_skillgraph.SMDPQLearning` on the same
    :class:`~sb3_skillgraph.OptionsEnv`. That one's global option should follow known ways: ``route=planner.route``.

    :param planner: plans over the graph
    :param env: tells which option is which action
    :raises ValueError: if the environment has no global option
    """

    def __init__(self, planner: GraphPlanner, env: OptionsEnv) -> None:
        self.planner = planner
        self.env = env
        self.global_action = env.global_action

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose options.

        :param observation: one observation of the options' environment, or a batch
        :param state: what the last call returned
        :param episode_start: where an episode begins, and the state is forgotten; shape ``(n_envs,)``
        :param deterministic: not used: plans are
        :return: the actions, and the state
        """
        assert isinstance(observation, dict)
        points = np.atleast_2d(observation["achieved_goal"])
        goals, masks = np.atleast_2d(observation["desired_goal"]), np.atleast_2d(observation[MASK])
        n_envs = len(points)
        last = GraphPolicyState(*np.array(state or np.tile([[-1], [0], [-1]], n_envs)))
        for i in range(n_envs):
            if episode_start is not None and episode_start[i]:
                last.action[i], last.failures[i], last.failed[i] = -1, 0, -1
            self._learn_of_failure(last, i, points[i])
            last.action[i] = self._choose(last, i, points[i], goals[i], masks[i])
        actions = last.action.copy()
        return (actions if np.ndim(observation["achieved_goal"]) == 2 else actions[0]), tuple(last)

    def _learn_of_failure(self, last: GraphPolicyState, i: int, point: np.ndarray) -> None:
        """Note whether the option that has just ended did not get where it leads."""
        action = int(last.action[i])
        if action == self.global_action:
            last.failures[i] += 1
        elif action >= 0:
            last.failed[i] = -1 if self.env.options[action].terminates(point) else action

    def _choose(self, last: GraphPolicyState, i: int, point: np.ndarray, goal: np.ndarray, mask: np.ndarray) -> int:
        avoid = [] if last.failed[i] < 0 else [self.env.options[last.failed[i]].id]
        legs = self.planner.legs(point, goal, avoid)
        path = legs[last.failures[i] // PATIENCE % len(legs)].path if legs else None
        if path is None:
            return self.global_action
        try:
            action = self.env.index(path.vertices[0])
        except KeyError:  # made after the environment was given its options
            return self.global_action
        return action if mask[action] else self.global_action
