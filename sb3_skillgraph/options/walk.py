"""Walks: the options that share one goal-conditioned policy, the walker."""

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph.events import Event
from sb3_skillgraph.options.option import Option


class Walk:
    """An option whose policy is the walker, given one event as its goal (section 2.1).

    Its initiation set are the events from which it has been seen to be possible: in the graph, those with an edge to it.

    :param id: its name, and that of its vertex in the skill graph
    :param target: id of the event it leads to
    :param termination: the event it leads to, where it ends
    :param learner: the SB3 model of the walker, which all walks share, or that of the skill in its place
    :param specialise: gives it a network of its own
    """

    def __init__(self, id: str, termination: Event, learner: OffPolicyAlgorithm, specialise: Callable[[str], Option]) -> None:
        self.id = id
        self.target = termination.id
        self.termination = termination
        self.learner = learner
        self._specialise = specialise

    def __repr__(self) -> str:
        return f"<walk {self.id} to {self.target}>"

    def specialise(self) -> Option:
        """Give it a network of its own, which begins as a copy of the walker's.

        From now on the agent runs this skill in place of the walk, and it learns whenever it runs: half of each minibatch is
        from its own runs, half from all experience.

        :return: the skill, the same at every call
        """
        return self._specialise(self.id)

    @property
    def subgoal(self) -> np.ndarray:
        """The point it aims at, shape ``(goal_dim,)``."""
        return self.termination.center

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Tell at which points it has succeeded.

        :param points: shape ``(n, goal_dim)``
        :return: bool array of shape ``(n,)``
        """
        return self.termination.contains(points)


class Walks(list[Walk]):
    """An agent's walks, in the order of their events, and what runs them.

    :param walks: the walks
    :param runner: the agent's :class:`~sb3_skillgraph.runner.Runner`
    """

    def __init__(self, walks: Iterable[Walk], runner: Any) -> None:
        super().__init__(walks)
        self.runner = runner
