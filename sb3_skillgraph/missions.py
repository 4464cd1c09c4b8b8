"""What one environment's agent is about, and how the agent chooses that (sections 3.2.2, 3.2.4)."""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from sb3_skillgraph.controller import Request


class Strategy(NamedTuple):
    """How targets are chosen; the fields are arguments of :class:`~sb3_skillgraph.SkillGraphAgent`, described there."""

    target_choice: Literal["nearest", "uniform"]
    practise_prob: float
    practise: Literal["least_tried", "random"]
    explore_prob: float
    exploration_steps: int
    explore_beyond: float
    max_tries: int
    link_reach: int
    off_policy_runs: bool


@dataclass
class Mission:
    """What one environment's agent is about: to reach an event or a point, and perhaps to explore from there.

    :param goal: where to go, shape ``(goal_dim,)``
    :param event: id of the target event; None for any other point
    :param chain: id of the chain to practise
    :param left_graph: whether the chain's source has been reached
    :param explore_steps: environment steps to explore on arrival
    :param beyond: the point to explore towards; None for a random walk
    :param exploring: whether exploration has begun
    :param n_failures: options that timed out during the mission
    """

    goal: np.ndarray
    event: str | None = None
    chain: str | None = None
    left_graph: bool = False
    explore_steps: int = 0
    beyond: np.ndarray | None = None
    exploring: bool = False
    n_failures: int = 0

    @property
    def request(self) -> Request:
        """The mission as the controller sees it."""
        if self.exploring:
            return Request(self.goal if self.beyond is None else self.beyond, direct=True)
        return Request(self.goal, self.event, self.chain, self.left_graph)

    @property
    def random_walk(self) -> bool:
        """Whether actions are to be random now."""
        return self.exploring and self.beyond is None
