"""The walker of a skill graph without the graph: straight on to every goal."""

import numpy as np

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.goal_env import as_batch
from sb3_skillgraph.metric import Metric


class StraightOn:
    """
    Walks to the goal itself, wherever it is: what an agent's goal-conditioned policy does without plans.

    :param agent: the agent whose walker it is; what that learns, this one knows
    """

    def __init__(self, agent: SkillGraphAgent) -> None:
        self.agent = agent

    @property
    def metric(self) -> Metric:
        """How near to a goal is there: the agent's."""
        return self.agent.metric

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Walk towards ``observation["desired_goal"]``.

        :param observation: one Dict observation, or a batch with a leading axis
        :param state: not used
        :param episode_start: not used
        :param deterministic: not used: there is no noise
        :return: actions in the environment's own bounds, and no state
        """
        batch, vectorized = as_batch(observation, self.agent.observation_space)
        actions = self.agent.parts.walk(batch, batch["desired_goal"])
        return (actions if vectorized else actions[0]), None
