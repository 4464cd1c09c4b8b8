"""The skill graph as a high level for an :class:`~sb3_skillgraph.OptionsEnv` (sections 3.2.4, 3.3)."""

from typing import Any

import numpy as np

from sb3_skillgraph.choices import PESSIMISTIC
from sb3_skillgraph.smdp.actions import WalkActions
from sb3_skillgraph.smdp.options_env import OptionsEnv


class GraphPolicy:
    """
    Chooses on an :class:`~sb3_skillgraph.OptionsEnv` the option that the agent's ``predict`` would run.

    It has SB3's ``predict`` and so is exchangeable with :class:`~sb3_skillgraph.SMDPQLearning` on the same environment. What
    has happened in the episode it takes from the environment, which keeps the agent's record of it. With ``**PAPER`` there are
    no walks: there the agent's own ``predict`` is all there is.

    :param agent: a :class:`~sb3_skillgraph.SkillGraphAgent`, which plans over its graph
    :param env: lifted by the agent's options; predictions are for where it stands
    :raises ValueError: if the environment's options are not the agent's
    """

    def __init__(self, agent: Any, env: OptionsEnv) -> None:
        if not isinstance(env.actions, WalkActions) or env.actions.runner is not agent.parts.runner:
            raise ValueError("The environment's options are not this agent's walks: give it OptionsEnv(env, agent.options).")
        self.env = env
        self.walks = env.actions

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose an option.

        :param observation: the observation of the options' environment
        :param state: not used
        :param episode_start: not used
        :param deterministic: not used: plans are
        :return: the action, and the state
        """
        assert isinstance(observation, dict)
        point, goal = (np.asarray(observation[key], dtype=np.float32).reshape(-1) for key in ("achieved_goal", "desired_goal"))
        chosen = self.walks.runner.choose(self.walks.state, 0, point, goal, PESSIMISTIC)
        action = np.array(self.env.index(chosen.option))
        return (action[None] if np.ndim(observation["achieved_goal"]) == 2 else action), state
